"""World cards: every id's numbers are those committed; a constant off by 0.1 % is told, as are bad
cards.

Worlds are simulated once each: ids that share a fluid follow each other, and so do the tests that
need it.
"""

import copy
import json

import pytest
from eitbench.bench import world_cards as cards
from eitbench.bench.world_cards import (
    CARDS,
    TOLERANCE,
    card,
    differences,
    disagreements,
    numbers,
    path_of,
    text_of,
)
from eitbench.data.store import CACHE_VARIABLE
from eitbench.worlds import entries, entry
from eitbench.worlds.pipe2d import PIPE_2D
from eitbench.worlds.pipe2d_obstacle import PIPE_2D_OBSTACLE

OURS = [id for id in entries() if id.startswith("eitbench/")]
FLUIDS = list(dict.fromkeys(entry(id).world.fluid for id in OURS))
SOLID = [id for id in OURS if entry(id).world.name == "Pipe3D"]
BY_FLUID = sorted(OURS, key=lambda id: FLUIDS.index(entry(id).world.fluid))


@pytest.fixture(autouse=True, scope="module")
def cache(tmp_path_factory):
    """What is kept on disk is not looked at: outlines are made anew too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(tmp_path_factory.mktemp("cache")))
        yield


def kept(id):
    """A committed card."""
    return json.loads(path_of(id).read_text())


def as_read(made):
    """Numbers as they are read from a card."""
    return json.loads(text_of(made))


@pytest.mark.parametrize("id", [
    pytest.param(id, marks=pytest.mark.slow) if id in SOLID else id for id in BY_FLUID])
def test_card_agrees(id):
    """Another number means another version of the id: ``-v1``. Three dimensions take a minute."""
    moved = disagreements(id)
    assert not moved, "\n".join([f"{id} is not what its card says; other numbers are another "
                                 "version of it.", *moved])


def test_every_id_of_ours_has_its_card_and_no_other_has():
    """A new id needs one."""
    assert sorted(CARDS.iterdir()) == sorted(map(path_of, OURS))


@pytest.mark.parametrize("id", OURS)
def test_text_is_short(id):
    """Ten digits a number, a few kB an id, and written as `text_of` does."""
    text = path_of(id).read_text()
    assert text_of(json.loads(text)) == text
    assert 2000 < len(text.encode()) < 6000
    for line in text.splitlines():
        digits = line.strip(" ,").lstrip("-").split("e")[0].replace(".", "").lstrip("0")
        assert len(digits) <= 10 or not digits.isdecimal()


# -- what moves the numbers ------------------------------------------------------------------------


def moved(id, changes):
    """Which numbers of this id's card differ, when its world is changed."""
    world = entry(id).world.changed(changes)
    return [line.split(" ")[0] for line in differences(as_read(numbers(world)),
                                                       {name: kept(id)[name]
                                                        for name in ("model", "episodes")})]


PLAIN = "eitbench/Pipe2D-v0"


@pytest.mark.parametrize(("part", "name", "shows"), [
    ("flow", "diffusivity", {"model.step", "episodes.train:0.resistance"}),
    ("vessel", "contact_impedance", {"model.homogeneous", "episodes.train:0.resistance"}),
    ("instrument", "noise_relative", {"episodes.train:0.voltages", "episodes.dev:0.homogeneous"}),
    ("instrument", "noise_of_largest", {"episodes.dev:0.homogeneous"}),
])
def test_constant_off_by_a_thousandth_shows(part, name, shows):
    """In the numbers that depend on it, and not in those that do not."""
    value = getattr(getattr(PIPE_2D, part), name)
    found = moved(PLAIN, {part: {name: 1.001 * value}})
    assert shows <= set(found)
    assert not {"episodes.train:0.noise", "episodes.train:0.broken_from"} & set(found)
    if part == "instrument":
        assert not [place for place in found if "moment" in place or place.startswith("model")]


def test_strength_of_slugs_off_by_a_thousandth_shows():
    """In what is carried; the estimators' model stays."""
    weakest, strongest = PIPE_2D.target.strength
    found = moved(PLAIN, {"target": {"strength": [1.001 * weakest, 1.001 * strongest]}})
    assert {"episodes.dev:0.moment", "episodes.dev:0.floor",
            "episodes.dev:0.voltages"} <= set(found)
    assert not [place for place in found if place.startswith("model")]


def test_viscosity_off_by_a_thousandth_shows():
    """Of the flow past the bulge, though the model knows nothing of it."""
    viscosity = 1.001 * PIPE_2D_OBSTACLE.flow.viscosity
    found = moved("eitbench/Pipe2DObstacle-v0", {"flow": {"viscosity": viscosity}})
    assert {"episodes.train:0.moment", "episodes.train:0.resistance"} <= set(found)
    assert not [place for place in found if place.startswith("model")]


# -- cards that are no good ------------------------------------------------------------------------


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """Cards in a folder of this test's own: that of the plain pipe, which is not simulated."""
    monkeypatch.setattr(cards, "CARDS", tmp_path)
    made = kept_card()
    monkeypatch.setattr(cards, "card", lambda id: copy.deepcopy(made))
    path_of(PLAIN).write_text(text_of(made))
    return path_of(PLAIN)


def kept_card():
    """The committed card of the plain pipe."""
    return json.loads((CARDS / "eitbench-Pipe2D-v0.json").read_text())


def test_sound_card_agrees_with_itself(elsewhere):
    """Nothing is said."""
    assert disagreements(PLAIN) == []


def test_missing_card_is_told(elsewhere):
    """With the id, and where it should lie."""
    elsewhere.unlink()
    (said,) = disagreements(PLAIN)
    assert PLAIN in said and str(elsewhere) in said and "missing" in said


@pytest.mark.parametrize("damage", [
    pytest.param(lambda text: text[:len(text) // 2], id="half"),
    pytest.param(lambda text: "", id="empty"),
    pytest.param(lambda text: text.replace("[", "(", 1), id="no JSON"),
    pytest.param(lambda text: "\ud800" + text, id="no UTF-8"),
])
def test_damaged_card_is_told(damage, elsewhere):
    """With the id, and no traceback."""
    elsewhere.write_bytes(damage(elsewhere.read_text()).encode("utf-8", "surrogatepass"))
    (said,) = disagreements(PLAIN)
    assert PLAIN in said and "damaged" in said


@pytest.mark.parametrize(("change", "message"), [
    (lambda made: made["episodes"]["dev:0"]["voltages"].pop(), "dev:0.voltages are 9 numbers, on"),
    (lambda made: made.pop("model"), "the card has other names: model"),
    (lambda made: made.update(id="eitbench/Other-v0"), "id is 'eitbench/Pipe2D-v0', the card says"),
    (lambda made: made.update(model=None), "model is"),
    (lambda made: made["model"].update(step=["fast"] * 5), "model.step on the card are no numbers"),
    (lambda made: made["model"].update(step=[None] * 5), "model.step"),
    (lambda made: made["episodes"].update({"dev:0": []}), "episodes.dev:0 is"),
])
def test_card_of_another_form_is_told(change, message, elsewhere):
    """Whichever number, name or kind is another."""
    made = kept_card()
    change(made)
    elsewhere.write_text(json.dumps(made))
    assert any(f"{PLAIN}: " in said and message in said for said in disagreements(PLAIN))


def test_number_that_moved_is_named(elsewhere):
    """With its place and both values; below the tolerance nothing is said."""
    made = kept_card()
    voltages = made["episodes"]["dev:0"]["voltages"]
    largest = max(map(abs, voltages))
    before = voltages[2]
    voltages[2] = before + 0.5 * TOLERANCE * largest
    elsewhere.write_text(text_of(made))
    assert disagreements(PLAIN) == []
    voltages[2] = before + 0.01 * largest
    elsewhere.write_text(text_of(made))
    (said,) = disagreements(PLAIN)
    assert said.startswith(f"{PLAIN}: episodes.dev:0.voltages differs by 0.01 of its largest")
    assert f"number 2 is {before:.10g}, the card says {voltages[2]:.10g}" in said


def test_number_that_is_none_is_told():
    """NaN agrees with nothing."""
    assert differences({"floor": [float("nan")]}, {"floor": [0.02]})


def test_card_names_its_id():
    """A card is of one id; what it says of the world is that of all with this world."""
    made = as_read(card("eitbench/StationaryTank2D-v0"))
    assert made.pop("id") == "eitbench/StationaryTank2D-v0"
    assert made == as_read(numbers(entry("eitbench/StationaryTank2D-v0").world))
