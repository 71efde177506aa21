"""The page of an id says what its objects are: sizes, lengths, numbers."""

import inspect
import re
from dataclasses import make_dataclass

import gymnasium as gym
import pytest
from eitbench import page
from eitbench.envs import pages
from eitbench.worlds import entries
from gymnasium import spaces


@pytest.fixture(scope="module", params=list(entries()))
def told(request):
    """Every id with its page and its environment."""
    return request.param, page(request.param), gym.make(request.param).unwrapped


def section(text: str, heading: str) -> str:
    """What the page says under a heading."""
    return text.split(f"## {heading}\n\n")[1].split("\n\n## ")[0]


def table(text: str) -> dict[str, str]:
    """First column -> second, of the rows of a page's tables."""
    return dict(re.findall(r"^\| `(\w[\w.]*)` \| (.*?) \|", text, re.MULTILINE))


def test_sections(told):
    """What the world says of itself comes first, and no placeholder is left."""
    id, text, _ = told
    headings = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert headings == ["Description", "Action space", "Observation space", "Reward",
                        "Starting state", "Episode end", "Arguments", "Numbers of the world"]
    assert section(text, "Description").strip() == entries()[id].about.strip()
    outside = text.replace(section(text, "Description"), "").replace("{\"", "").replace("{{", "{")
    assert not re.search(r"\{(lag|last|gate|columns|rows)\}", outside)


def test_sizes_are_the_spaces(told):
    """Of actions and of every entry of an observation."""
    id, text, env = told
    actions = section(text, "Action space")
    if isinstance(env.action_space, spaces.Discrete):
        assert f"`Discrete({env.action_space.n})`" in actions
        last = "The last action is no injection" in actions
        assert last == (env.world.schedule.budget is not None)
    else:
        assert str(env.action_space.shape) in actions
    shown = env.observation_space
    observation = section(text, "Observation space")
    if entries()[id].track == "injection":
        assert str(shown.shape) in observation
        shown = gym.make(id, observation="raw").unwrapped.observation_space
    rows = table(observation)
    assert rows == {name: str(space.shape) for name, space in shown.items()}


def test_lengths_are_those_of_an_episode(told):
    """Steps, scored states, and the agent's first injection."""
    id, text, env = told
    world = env.world
    end = section(text, "Episode end")
    scored = world.schedule.scored_steps
    if entries()[id].track == "estimation":
        assert f"after {world.n_steps + env.task.lag} steps" in end
        assert f"{env.n_nodes:,} nodes" in section(text, "Action space")
        states = f"{scored} scored states t = {world.warm_up + 1} … {world.n_steps}"
        assert states in section(text, "Reward")
    else:
        frame = len(world.currents)
        assert f"after {world.n_steps - frame} steps ({world.n_steps} with" in end
        assert f"The first {frame} injections" in section(text, "Starting state")
        assert f"{scored} scored states" in section(text, "Reward")
    flowing = f"flowing for {world.lead_in} time steps" in section(text, "Starting state")
    assert flowing == bool(world.lead_in)


def test_arguments_are_those_of_the_environment(told):
    """By their names, with what is taken where nothing is given."""
    id, text, env = told
    rows = table(section(text, "Arguments"))
    taken = set(inspect.signature(type(env)).parameters)
    assert set(rows) - {"threads"} == taken - {"name"}
    settings = entries()[id].settings
    if entries()[id].track == "estimation":
        assert rows["lag"] == str(env.lag)
    else:
        assert rows["gate"] == (f"{settings['gate']:g}" if "gate" in settings else "None")
    assert rows["episodes"] == str(inspect.signature(type(env)).parameters["episodes"].default)


def test_numbers_are_the_worlds(told):
    """Every one by the name under which `world` changes it, with its value."""
    _, text, env = told
    rows = table(section(text, "Numbers of the world"))
    for name, value in rows.items():
        part = env.world
        for each in name.split("."):
            part = getattr(part, each)
        if name.count(".") and not hasattr(part, "__dataclass_fields__"):
            assert value == str(list(part) if isinstance(part, tuple) else part)
    for name in ("schedule.time_step", "schedule.budget", "instrument.noise_relative",
                 "prior.nodal_std", "target.background", "vessel.electrode_cover"):
        assert name in rows
    assert "name" not in rows


def test_there_is_no_page_of_what_is_not_registered():
    """And it says which there are."""
    message = r"env must be one of eitbench/Pipe2D-v0, .*got 'mine/No-v0'"
    with pytest.raises(ValueError, match=message):
        page("mine/No-v0")


def meanings(text: str) -> dict[str, str]:
    """Name -> last cell of each row of the numbers."""
    rows = re.findall(r"^\| `([^`]+)` \| .*? \| (.*) \|$", section(text, "Numbers of the world"), re.MULTILINE)
    return dict(rows)


def test_no_number_stands_without_a_meaning(told):
    """Beside each is what its source says of it."""
    _, text, _ = told
    said = meanings(text)
    assert len(said) > 30 and not [name for name, meaning in said.items() if not meaning]


def test_numbers_have_their_units():
    """As their source has them."""
    said = meanings(page("eitbench/Pipe2D-v0"))
    assert said["vessel.length"] == "m [T]"
    assert said["vessel.contact_impedance"] == "z in Ω·m² [ours]"
    assert said["schedule.time_step"] == "s between two injections [T]"
    assert said["region"].startswith("m along the vessel")


def test_parts_say_what_they_are_for():
    """Before what their own class says; a bar within a cell is escaped."""
    said = meanings(page("eitbench/Pipe2D-v0"))
    assert said["prior"].startswith("what estimators are told to believe. What is believed before any measurement")
    made = type("Bar", (), {"__doc__": "|I| ≤ 1"})
    part = make_dataclass("Bar", [("size", int, 1)], bases=(made,))
    part.__doc__ = made.__doc__
    assert pages._rows("bar", part(), "a limit")[0] == r"| `bar` | Bar | a limit. \|I\| ≤ 1 |"
