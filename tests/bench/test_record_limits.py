"""Records that no run could have made: boards that are not the environment's, names and numbers out of bounds."""

import json
import os
from inspect import signature

import pytest
from eitbench._foreign import as_markdown, cleaned
from eitbench.bench.records import BOARDS, file_name, read_record, sealed, write_record
from eitbench.bench.strict_json import DEEPEST, MOST_BYTES
from eitbench.bench.tracks import ARGUMENTS, boards_of, named
from eitbench.envs.estimation import EstimationEnv
from eitbench.envs.injection import InjectionEnv
from eitbench.worlds import entry

from tiny import RUN, episode, record

PIPE, LATER, LONG = "eitbench/Pipe2D-v0", "eitbench/Pipe2DFixedLag-v0", "eitbench/Pipe2DSmoothing-v0"
TOO_LONG = entry(PIPE).world.n_steps - 1


def left(folder, content, name=None, old="", new=""):
    """A file as somebody might leave it, with a piece of its text replaced."""
    folder.mkdir(exist_ok=True)
    path = folder / (name or file_name(content))
    text = json.dumps(content)
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return path


@pytest.mark.parametrize(("id", "kwargs", "boards"), [
    (PIPE, {}, "filter"), (PIPE, {"lag": 0}, "filter"), (PIPE, {"lag": 3}, "fixed-lag"), (LATER, {}, "fixed-lag"),
    (PIPE, {"lag": TOO_LONG}, "smoothing"), (LONG, {}, "smoothing"), (LONG, {"lag": 0}, "filter"),
    (LONG, {"lag": None}, "smoothing"), (PIPE, {"lag": "all", "world": {"flow": {}}}, "smoothing"),
    (PIPE, {"lag": 3, "world": {"schedule": {"scored_steps": 1}}}, "fixed-lag smoothing"),
    ("eitbench/Pipe2DInjection-v0", {"gate": 3.0}, "injection")])
def test_a_board_is_that_of_the_environment(id, kwargs, boards, tmp_path):
    """Whatever the record calls it: who chose a board of his own could shut everybody else out of its aggregate."""
    assert boards_of(id, kwargs) == tuple(boards.split())
    environment = {"id": id, "name": named(id, kwargs), "kwargs": kwargs}
    for board in BOARDS:
        made = record("mine", [0.1], board=board, environment=environment)
        if board in boards.split():
            assert read_record(write_record(tmp_path, made)) == made
        else:
            path = left(tmp_path / board, made)
            message = rf"{path.name} is not valid: \$\.board: must be {' or '.join(boards.split())}, as the environment"
            with pytest.raises(ValueError, match=message):
                read_record(path)


@pytest.mark.parametrize(("kwargs", "message"), [
    ({"scenario": 5}, "scenario is no argument of"), ({"world": 5}, "world must be an object, got int"),
    ({"world": [1]}, "world must be an object, got list"), ({"assume": "all"}, "assume must be an object, got str"),
    ({"lag": -1}, "lag must be 'all' or an integer"), ({"lag": 1.5}, "lag must be"), ({"lag": True}, "lag must be"),
    ({"lag": "some"}, "lag must be"), ({"lag": {}}, "lag must be")])
def test_arguments_that_there_are_not(kwargs, message, tmp_path):
    """Nobody could play it; tables would be made of them."""
    environment = {"id": PIPE, "name": named(PIPE, kwargs), "kwargs": kwargs}
    with pytest.raises(ValueError, match=rf"\$\.environment\.kwargs: {message}"):
        read_record(left(tmp_path, record("mine", [0.1], environment=environment)))


def test_the_arguments_are_those_of_the_environments():
    """And no others."""
    for track, single in (("estimation", EstimationEnv), ("injection", InjectionEnv)):
        assert sorted(ARGUMENTS[track]) == sorted(set(signature(single).parameters) - {"name"})


# -- numbers ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", ["1e999", "-1e999", "NaN", "Infinity", "9" * 400, "9" * 5000, str(2**63)])
@pytest.mark.parametrize("place", ['"parameters": {"a": 7}', '"peak_memory": 7', '"seconds": 7', '"error": 7'])
def test_numbers_that_no_float_holds_are_named_with_the_file(number, place, tmp_path):
    """Wherever they stand."""
    mine = record("mine", [7], parameters={"a": 7}, episodes=[episode("test:0", 7) | {"seconds": 7, "peak_memory": 7}])
    path = left(tmp_path, mine, old=place, new=place.replace("7", number))
    with pytest.raises(ValueError, match=f"record .*{path.name} (cannot be read|is not valid)"):
        read_record(path)


@pytest.mark.parametrize("number", [1e51, -1e51, 1e-101, 1e308, 5e-324])
@pytest.mark.parametrize("place", ["nis", "error", "seconds", "matmul_seconds"])
def test_numbers_out_of_bounds_are_named_with_the_file(number, place, tmp_path):
    """Ratios and squares of what is within are finite."""
    value = abs(number)
    one = episode("test:0", value if place == "error" else 0.1, nis=number if place == "nis" else 1.0)
    one |= {"seconds": value} if place == "seconds" else {}
    run = RUN | {"machine": RUN["machine"] | ({"matmul_seconds": value} if place == "matmul_seconds" else {})}
    mine = record("mine", [0.1], episodes=[one], runs=[run])
    with pytest.raises(ValueError, match=rf"{file_name(mine)} is not valid: .*{place}.* must be 0 or of a size from"):
        read_record(left(tmp_path, mine))
    with pytest.raises(ValueError, match=rf"{file_name(mine)} is not valid"):
        write_record(tmp_path / "new", mine)


def test_what_is_too_deep_or_too_large_is_named(tmp_path):
    """Before anything is made of it."""
    for depth, message in ((DEEPEST, "nested deeper than 32 levels"), (50_000, "cannot be read")):
        path = left(tmp_path, record("mine", [0.1], parameters={"a": 7}), old='{"a": 7}',
                    new='{"a": ' + "[" * depth + "]" * depth + "}")
        with pytest.raises(ValueError, match=f"record .*{path.name}.*{message}"):
            read_record(path)
    path.write_bytes(b" " * (MOST_BYTES + 1))
    with pytest.raises(ValueError, match=rf"{path.name} cannot be read: it is no file of at most 8 MiB"):
        read_record(path)
    path.unlink()
    os.mkfifo(path)                                                  # reading it would wait for ever
    with pytest.raises(ValueError, match="it is no file"):
        read_record(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(ValueError, match="it is no file"):
        read_record(path)


@pytest.mark.parametrize(("place", "changes"), [
    (r"runs\[0\]\.walls: must be at most 20 texts", {"runs": [RUN | {"walls": [{"a": i} for i in range(100_000)]}]}),
    (r"runs\[1\]\.walls: must be at most 20 texts", {"runs": [RUN, RUN | {"walls": [[]]}]}),
    (r"runs: must be at most 10000", {"runs": [RUN] * 10_001}),
    (r"episodes: must be at most 10000", {"episodes": [1] * 10_001}),
    (r"step_errors: must be at most 100000", {"episodes": [episode("test:0", 0.1) | {"step_errors": [0.1] * 100_001}]}),
])
def test_lists_that_are_too_long_are_not_looked_at(place, changes, tmp_path):
    """Whether the items of a list are different ones is asked of a few only: each is compared with each."""
    with pytest.raises(ValueError, match=rf"is not valid: \$\.(episodes\[0\]\.)?{place}"):
        read_record(left(tmp_path, record("mine", [0.1], **changes)))


def test_steps_are_as_many_in_every_episode(tmp_path):
    """Pages average them step by step."""
    episodes = [episode("test:0", 0.1), episode("test:1", 0.1) | {"step_errors": [0.1, 0.1]}]
    with pytest.raises(ValueError, match=r"\$\.episodes: must have as many step_errors each"):
        read_record(left(tmp_path, record("mine", [0.1, 0.1], episodes=episodes)))


# -- names ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", ["\x1b[2J", "\x07", "\x9b", "\u202e", "\u2066", "\u200b", "\u2028", "\x00"])
def test_names_are_seen_as_they_are(sign, tmp_path):
    """Neither a method nor its title moves the cursor, hides a letter or turns the text round."""
    for field in ("method", "title"):
        mine = record("mine", [0.1])
        mine = sealed(mine | {field: f"mi{sign}ne"})
        with pytest.raises(ValueError, match=rf"\$\.{field}: must have no control characters") as caught:
            read_record(left(tmp_path, mine, "it.json"))
        assert sign not in str(caught.value)
    assert sign[0] not in cleaned(f"mi{sign}ne")


def test_long_names_and_versions_are_refused(tmp_path):
    """They become names of files."""
    with pytest.raises(ValueError, match=r"\$\.method: must have 100 letters at most"):
        write_record(tmp_path, record(101 * "x", [0.1]))
    with pytest.raises(ValueError, match=r"\$\.version: must have 9 digits at most"):
        write_record(tmp_path, record("mine", [0.1], version="v1234567890"))
    write_record(tmp_path, record(100 * "x", [0.1], version="v123456789"))


def test_half_a_letter_is_named_with_the_file(tmp_path):
    """It is no text, and could not be written."""
    path = left(tmp_path, record("mine", [0.1], title="abc"), old='"abc"', new='"\\ud800"')
    with pytest.raises(ValueError, match=f"record .*{path.name} cannot be read: .*surrogates"):
        read_record(path)


def test_the_file_s_own_name_is_cleaned(tmp_path):
    """A message never prints what a stranger called his file."""
    path = left(tmp_path, record("mine", [0.1]), name="a\x1b[31m\u202e.json")
    with pytest.raises(ValueError, match="must have the name") as caught:
        read_record(path)
    assert "\\x1b[31m\\u202e.json" in str(caught.value) and "\x1b" not in str(caught.value)


def test_what_is_cleaned():
    """Letters of all languages stay; ends of lines where there may be several."""
    for same in ("ẽ_c ± 5 %", "Kálmán 卡尔曼 كالمان", "kalman_filter@v1", "a\u0301"):
        assert cleaned(same) == same == as_markdown(same)
    assert cleaned("a\nb\tc") == "a\\nb\\tc" and cleaned("a\nb\tc\r", lines=True) == "a\nb\tc\\r"


@pytest.mark.parametrize(("text", "expected"), [
    ("a|b", r"a\|b"), ("<b>x</b>", r"\<b\>x\</b\>"), ("[x](http://y)", r"\[x\](http\://y)"), ("*x*", r"\*x\*"),
    ("`x`", r"\`x\`"), ("_x_ a_b", r"\_x\_ a_b"), ("~~x~~", r"\~\~x\~\~"), ("&lt;", r"\&lt;"), ("\\|", r"\\\|"),
    ("![x](y)", r"\!\[x\](y)"), ("www.x.org", r"www\.x.org"), ("a\nb", r"a\\nb"), ("\x1b", r"\\x1b")])
def test_markdown_is_text(text, expected):
    """Of a stranger's title nothing is drawn, linked or left out."""
    assert as_markdown(text) == expected
