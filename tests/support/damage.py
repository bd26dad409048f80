"""Damaged checkpoints and incomplete ones, and the check that damage is refused."""

import contextlib
import shutil
from unittest import mock

import pytest
import toy
from runs import files_of, save_toy

from vawm.errors import InvalidInput
from vawm.runs import checkpoint
from vawm.runs.checkpoint import handle, writing


def flip(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def truncate(file):
    file.write_bytes(file.read_bytes()[:-1])


def delete(file):
    file.unlink()


def harms(rng):
    """Functions `(file, files)` that damage `file`, one of all `files`."""

    def at(content):
        return rng.randrange(len(content))

    def bit(file, _):
        content = bytearray(file.read_bytes())
        content[at(content)] ^= 1 << rng.randrange(8)
        file.write_bytes(content)

    def cut(file, _):
        content = file.read_bytes()
        file.write_bytes(content[: at(content)])

    def zeros(file, _):
        content = bytearray(file.read_bytes())
        start = at(content)
        content[start : start + 16] = bytes(len(content[start : start + 16]))
        file.write_bytes(content)

    def noise(file, _):
        file.write_bytes(rng.randbytes(len(file.read_bytes())))

    def inserted(file, _):
        content = bytearray(file.read_bytes())
        content[(start := at(content)) : start] = rng.randbytes(rng.randrange(1, 9))
        file.write_bytes(content)

    def another(file, files):
        file.write_bytes(rng.choice(files).read_bytes())

    def folder(file, _):
        file.unlink()
        file.mkdir()

    def gone(file, _):
        file.unlink()

    return (bit, bit, bit, cut, zeros, noise, inserted, another, folder, gone)


def corrupt(logdir, expected, count, rng):
    """Damages the only checkpoint, which holds `expected`, `count` times, one file each time.

    Returns how often it was refused, which must be every time that a file has changed.
    """
    files = files_of(logdir)
    contents = {file: file.read_bytes() for file in files}
    refused = 0
    for _ in range(count):
        file, harm = rng.choice(files), rng.choice(harms(rng))
        harm(file, files)
        if file.is_file() and file.read_bytes() == contents[file]:
            toy.assert_equal(checkpoint.restore(logdir, expected)[0], expected)
        else:
            with pytest.raises(InvalidInput) as error:
                checkpoint.restore(logdir, expected)
            assert "\n" not in str(error.value)
            refused += 1
        if file.is_dir():
            file.rmdir()
        file.write_bytes(contents[file])
    return refused


def save_unmerged(logdir, state, env_steps):
    """Saves as earlier versions did in a path with brackets: Orbax does not merge its files.

    Returns the checkpoint, which `vawm.runs.checkpoint.store` describes.
    """
    with (
        mock.patch.object(handle, "plain", contextlib.nullcontext),
        mock.patch.object(writing, "_check"),
    ):
        saved = save_toy(logdir / "[1e-4]", state, env_steps)
    path = checkpoint.root(logdir) / saved.name
    path.parent.mkdir(exist_ok=True)
    saved.rename(path)
    shutil.rmtree(logdir / "[1e-4]")
    return path
