"""Invalid arguments and estimates are named."""

import gymnasium as gym
import numpy as np
import pytest
from estimation_envs import BIASED, OBSTACLE, PIPE, SOLID, STIRRED, UNKNOWN, make

from injection_envs import FAULTS, FLOW, INFLOW, NAME, TANK


@pytest.mark.parametrize(("id", "change", "message"), [
    (PIPE, {"lag": -1}, "lag must be an integer"),
    (PIPE, {"lag": "some"}, "lag must be 'all'"),
    (PIPE, {"split": "test"}, "split must be train or dev"),
    (PIPE, {"render_mode": "tv"}, "render_mode must be"),
    (PIPE, {"episodes": 0}, "episodes must"),
    (PIPE, {"assume": {"mean_velocity": -1.0}}, "assume.mean_velocity must be a finite number"),
    (PIPE, {"assume": 4.5}, "assume must be a dict of assumptions on the flow, got 4.5"),
    (SOLID, {"assume": {"profile": "plug"}}, "assume has no 'profile'; there are mean_velocity"),
    (STIRRED, {"assume": {"flow": "real"}}, "this world has nothing to assume"),
    (OBSTACLE, {"assume": {"flow": "guessed"}}, "assume.flow must be one of parabolic, real"),
    (BIASED, {"assume": {"mean_velocity": "fast"}}, "assume.mean_velocity must be a number in m/s"),
    (UNKNOWN, {"world": {"flow": {"profiles": "four"}}}, "profiles must be None, 'mean' or 'three'"),
    (OBSTACLE, {"world": {"vessel": {"bulge": {"height": 0.06}}}}, "bulge.height must be"),
    (STIRRED, {"world": {"region": [0.1, 0.2]}}, "region must be None in a RoundTank"),
    (NAME, {"estimator": "exact"}, "estimator must be one of reduced, full, none; got 'exact'"),
    (NAME, {"gate": 0.0}, "gate must be"),
    (NAME, {"world": {"instrument": {"current_norm": "L3"}}}, "current_norm must be one of L1, L2, Linf"),
    (INFLOW, {"inflow": "pink"}, "inflow must be one of white, learned; got 'pink'"),
    (FLOW, {"inflow": "learned"}, "inflow must be 'white' where the velocity is estimated too"),
    (TANK, {"inflow": "learned"}, "inflow must be 'white' for a target without inflow"),
    (FLOW, {"world": {"region": [0.283, 0.4]}}, "multiples of 0.01 m"),
    (FAULTS, {"world": {"schedule": {"warm_up": 1, "scored_steps": 4}}},
     r"world.schedule must have more time steps than the cycle of 16 .* got 5"),
    (FAULTS, {"world": {"instrument": {"n_loose_range": "01"}}}, "n_loose_range must be an array of numbers, got str"),
    (NAME, {"gains": True}, "gains must be False in a world without a moving body, got True"),
    (NAME, {"world": {"instrument": {"readings": "chosen"}}}, "readings must be 'all' in an injection environment"),
    (NAME, {"faults": "estimated"}, "faults must be 'gate' for an instrument without faults"),
])
@pytest.mark.filterwarnings("ignore")
def test_wrong_arguments_are_named(id, change, message):
    with pytest.raises(ValueError, match=message):
        gym.make(id, **change)


def bad(n: int, place: int, value: float) -> np.ndarray:
    """Return (n,) thirties except one."""
    action = np.full(n, 30.0)
    action[place] = value
    return action


@pytest.mark.parametrize(("id", "action", "message"), [
    (PIPE, np.zeros(5), r"action must have shape \(1701,\), got \(5,\)"),
    (PIPE, np.full(1701, np.nan), "action must be finite"),
    (PIPE, np.full(1701, 1e4), "action must lie within ±250 mol/m³"),
    (PIPE, "thirty", "action must be an array of numbers in mol/m³, got str"),
    (PIPE, np.full(1701, 30.0 + 1.0j), "action must be an array of numbers in mol/m³, got ndarray of complex128"),
    (PIPE, np.ma.masked_all(1701), "action must be an array of numbers in mol/m³, got MaskedArray of float64"),
    (UNKNOWN, np.full(1701, 30.0), r"action must have shape \(1702,\), got \(1701,\)"),
    (UNKNOWN, bad(1702, -1, np.nan), r"action must be finite.* the first at index \(1701,\)"),
    (UNKNOWN, bad(1702, -1, 451.0), "action must lie within ±450 m/s, got 451"),
])
def test_wrong_actions_are_named(id, action, message):
    """An invalid estimate is rejected with its value and the expectation."""
    env = make(id).unwrapped
    env.reset(seed=1)
    with pytest.raises(ValueError, match=message):
        env.step(action)


@pytest.mark.parametrize("ask", ["truth", "true_velocity", "privileged_info"])
def test_a_reset_is_required(ask):
    """Rendering, steps and errors require a reset, which has no options."""
    env = make(PIPE).unwrapped
    with pytest.raises(gym.error.ResetNeeded, match=rf"call reset\(\) before {ask}\(\)"):
        getattr(env, ask)()
    with pytest.raises(gym.error.ResetNeeded, match=r"call reset\(\) before step\(\)"):
        env.step(np.full(1701, 30.0))
    with pytest.raises(ValueError, match="options must be None or empty"):
        env.reset(options={"split": "dev"})
    with pytest.raises(gym.error.ResetNeeded, match=r"call reset\(\) before error"):
        make(NAME).unwrapped.error  # noqa: B018
