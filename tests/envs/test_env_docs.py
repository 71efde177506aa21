"""The page of an id names the sizes of its spaces, its lengths, its arguments and all numbers of its world."""

import inspect
import re

import gymnasium as gym
import pytest
from eitbench import describe_environment
from eitbench.worlds import entries


@pytest.fixture(scope="module", params=list(entries()))
def described(request):
    """Return an id with its page and its environment."""
    return request.param, describe_environment(request.param), gym.make(request.param).unwrapped


def section(text: str, heading: str) -> str:
    """Return the section of a page below a heading."""
    return text.split(f"## {heading}\n\n")[1].split("\n\n## ")[0]


def table(text: str, column: int = 1) -> dict[str, str]:
    """Map the first column of a page's tables to another column."""
    rows = re.findall(r"^\| `?([\w .'’]+?)`? \| (.*?) \|(?: (.*) \|)?$", text, re.MULTILINE)
    return {row[0]: row[column].strip("`") for row in rows}


def test_sections_and_sizes(described):
    """The page begins with the description, without placeholders; sizes equal the spaces and the episode's length."""
    id, text, env = described
    assert re.findall(r"^## (.*)$", text, re.MULTILINE) == [
        "Description", "Action Space", "Observation Space", "Rewards", "Starting State", "Episode End",
        "Arguments", *["Returns"] * (entries()[id].track == "injection"), "World"]
    assert section(text, "Description").startswith(entries()[id].description.strip()) and "$" not in text
    sizes = table(section(text, "Description"))
    world = env.world
    space = env.action_space
    assert str(space.shape if isinstance(space, gym.spaces.Box) else space) in sizes["action space"]
    assert sizes["steps of an episode"] == str(env.episode_steps)
    assert sizes["scored states"] == f"{world.schedule.scored_steps}: t = {world.warm_up + 1} … {world.n_steps}"
    observed = env.observation_space
    if entries()[id].track == "injection":
        observed = gym.make(id, observation="raw").unwrapped.observation_space
        assert sizes["gate"] == f"{entries()[id].settings.get('gate', float('inf')):g}"
    shapes = table(section(text, "Observation Space"))
    assert {name: shapes[name] for name in observed} == {name: str(space.shape) for name, space in observed.items()}


def test_threshold_is_the_best_published_return(described):
    """Each injection environment publishes the returns of groups of policies; the threshold of its spec is the largest
    without training, above the random pair."""
    id, text, _ = described
    threshold = gym.spec(id).reward_threshold
    if entries()[id].track != "injection":
        assert threshold is None
        return
    returns = {group: float(value.split(" ± ")[0]) for group, value in table(section(text, "Returns"), 2).items()
               if group != "group"}
    assert {"random", "open loop", "adaptive"} <= set(returns)
    assert round(threshold, 3) == max(returns["open loop"], returns["adaptive"])
    assert returns["random"] < threshold


def test_arguments_and_numbers_are_those_of_the_environment(described):
    """The page lists the arguments of the environment's class by name, and each parameter by its
    name in the argument `world`, with value and meaning."""
    _, text, env = described
    listed = set(table(section(text, "Arguments"))) - {"name", "threads"}
    assert listed == set(inspect.signature(type(env)).parameters) - {"name"}
    values, meanings = (table(section(text, "World"), column) for column in (1, 2))
    for name, value in values.items():
        part = env.world
        for each in name.split("."):
            part = getattr(part, each, part)
        if name.count(".") and not hasattr(part, "__dataclass_fields__"):
            assert value == str(list(part) if isinstance(part, tuple) else part)
    assert len(values) > 30 and all(meanings.values())
    assert {"schedule.time_step", "instrument.noise_relative", "prior.nodal_std", "target.background"} <= set(values)
