"""The command line of programs."""

import sys

from vawm.errors import InvalidInput

# So a module that is a program imports this room before any that needs networks.
try:
    import vawm.nets.distributions  # noqa: F401
except InvalidInput as error:  # this Python cannot run anything; `guard` is not imported yet
    print(f"error: {error}", file=sys.stderr)
    sys.exit(2)
