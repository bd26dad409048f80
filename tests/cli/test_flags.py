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


@pytest.mark.parametrize(
    ("word", "number"),
    [("1e6", "1000000"), ("2.5e3", "2500"), ("1_0e2", "1000"), ("-2E+1", "-20")],
)
def test_a_whole_number_in_other_words(word, number):
    assert flags.whole(word) == number


@pytest.mark.parametrize("word", ["1.5e0", "1e-3", "1__0e3", "1e", "e5", "x", "1e999", "7", ""])
def test_other_words_stay_as_they_are(word):
    assert flags.whole(word) == word


def test_only_whole_numbers_are_rewritten():
    options = read(
        "--name", "1e3", "--inner.rate_", "1e3", "--seeds", "1e1", "2", "--length=3e0"
    )
    assert options == Options("1e3", length=3, seeds=(10, 2), inner=Inner(1e3))


@dataclasses.dataclass(frozen=True)
class Outer(Options):
    batch_size: int = 2
    """sequences
    in a batch"""
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Further(Outer):
    batch_size: int = 3


def test_the_sentence_of_a_flag_is_the_string_below_its_field():
    said = flags.sentences(Further)
    assert said.keys() == flags.known(Further).keys()
    assert {flag: text for flag, text in said.items() if text} == {
        "--batch-size": "sequences in a batch"
    }


def test_a_flag_without_a_default_is_required():
    with pytest.raises(InvalidInput, match="--name=None: is required"):
        flags.read(Options, [])
    with pytest.raises(InvalidInput, match="--name=None: is required"):
        flags.read(Options, ["--no-deep", "--length", "3"])
    with pytest.raises(InvalidInput, match="--nane='x': no such flag; did you mean '--name'"):
        flags.read(Options, ["--deep", "--nane", "x"])


def test_help_is_the_one_of_tyro(capsys):
    with pytest.raises(SystemExit, match="0"):
        read("--help")
    assert "--inner.kind {round,square}" in capsys.readouterr().out
