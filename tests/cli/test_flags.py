"""One line for every kind of error on a command line."""

import dataclasses
import re
from typing import Literal

import pytest

from vawm.cli import flags
from vawm.errors import InvalidInput


@dataclasses.dataclass(frozen=True)
class Inner:
    rate_: float = 0.5
    kind: Literal["round", "square"] = "round"


@dataclasses.dataclass(frozen=True)
class Options:
    name: str
    batch_size: int = 1
    length: int | None = None
    seeds: tuple[int, ...] = (0,)
    deep: bool = False
    inner: Inner = dataclasses.field(default_factory=Inner)


def read(*argv):
    return flags.read(Options, ["--name", "x", *argv])


def test_flags_are_read_with_both_spellings():
    options = read("--batch_size", "3", "--inner.rate_=0.1", "--seeds", "1", "2", "--deep")
    assert options == Options("x", 3, None, (1, 2), True, Inner(0.1))
    assert flags.read(Options, [], default=options) == options


def test_known_flags_are_spelled_as_tyro_does():
    for flag, value in [
        ("--batch-size", "1"),
        ("--inner.rate_", "1"),
        ("--inner.kind", "round"),
    ]:
        assert flag in flags.known(Options)
        read(flag, value)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--batchsize", "5"], "--batchsize='5': .*--batch-size"),
        (["--batch-sizes=5"], "--batch-sizes='5': .*--batch-size"),
        (["--inner.knid", "a"], "--inner.knid='a': .*--inner.kind"),
        (["--zzz"], "--zzz=None: .*--help"),
        (["stray"], "argument='stray': "),
        (["--deep", "yes"], "argument='yes': "),
        (["--batch-size", "x"], "--batch-size='x': "),
        (["--batch_size=1.5"], "--batch-size='1.5': "),
        (["--length", "x"], "--length='x': "),
        (["--seeds", "1", "x"], "--seeds='1 x': "),
        (["--inner.rate_", "x"], "--inner.rate_='x': "),
        (["--inner.kind", "rund"], "--inner.kind='rund': .*'round'"),
        (["--batch-size"], "--batch-size=None: "),
    ],
)
def test_an_error_names_flag_value_and_remedy(argv, message, capsys):
    with pytest.raises(InvalidInput) as error:
        read(*argv)
    assert re.match(message, str(error.value))
    assert "\n" not in str(error.value)
    output = capsys.readouterr()
    assert not output.out + output.err


def test_a_flag_without_a_default_is_required():
    with pytest.raises(InvalidInput, match="--name=None: is required"):
        flags.read(Options, [])


def test_help_is_the_one_of_tyro(capsys):
    with pytest.raises(SystemExit, match="0"):
        read("--help")
    assert "--inner.kind {round,square}" in capsys.readouterr().out
