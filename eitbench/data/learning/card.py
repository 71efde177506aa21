"""The card of exported examples: what they are, in which units, and where they come from."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from eitbench.data.seeds import is_test, parse_seeds

if TYPE_CHECKING:
    from eitbench.data.learning.examples import Dataset

INTEGRAL = "(mol/m³)²·m² (m³ in 3D)"
UNITS = {"seed": "", "t": "", "voltages": "V", "currents": "A (A/m in 2D)", "truth": "mol/m³",
         "unresolved": INTEGRAL, "square": INTEGRAL, "velocity": "m/s"}
"""Of each field."""

FIELDS = """\
| field | shape | unit | |
| --- | --- | --- | --- |
| `seed` | | | of the episode |
| `voltages` | ({T}, {L}) | {voltages} | noisy readings at t = 1 … {T}, {ms:g} ms apart |
| `currents` | ({T}, {L}) | {currents} | injected |
| `truth` | ({T}, {n}) | {truth} | concentration at the nodes of `mesh.npz`{which} |
| `unresolved` | ({T},) | {unresolved} | ∫(p_t − c_t)² |
| `square` | ({T},) | {square} | ∫c_t² |
| `velocity` | ({T}, {k}) | {velocity} | parameters of the flow{asked} |
"""

TRUE = ": the projection p_t of what was simulated, c_t on a finer mesh"
SURROGATE = """
**These episodes are surrogates**, to learn from only. What flows in, how the fluid moves, noise and
faults are those of the true episode of the same seed. The concentration is carried in few
directions of a coarse mesh, voltages are quadratic in its logarithm, and nothing is beneath the
nodes, so that `unresolved` is zero. Choose and report on true episodes. Made of: `{source}`.
"""
EXACT = ("Errors are those of the leaderboards, exactly, although the finer mesh of the truth is "
         "not here:")
OF_SURROGATE = "Errors as on the leaderboards, but beside the surrogate's concentration:"

SCORE = """\
```python
import numpy as np
import scipy.sparse as sp

mesh = np.load("mesh.npz")
mass = sp.csr_array((mesh["mass_data"], mesh["mass_indices"], mesh["mass_indptr"]))
off = estimate - truth              # ({T}, {n})
errors = (np.einsum("tn,nt->t", off, mass @ off.T) + unresolved) / square
score = errors[{warm_up}:].mean()         # ẽ_c: the first {warm_up} states do not count
```
"""


def card(examples: Dataset, identity: dict[str, Any], files: Iterable[str]) -> bytes:
    """README.md of an export that holds these files, named as ``train-17``."""
    world = examples.world
    flow = world.velocity_model
    sizes = {"T": world.n_steps, "L": world.vessel.n_electrodes, "n": examples.mesh.n_nodes,
             "k": 0 if flow is None else flow.size, "warm_up": world.warm_up,
             "ms": 1e3 * world.time_step,
             "asked": "; none here" if flow is None else " that fit the true flow best"}
    held = ranges(files)
    reserved = ("\nTest episodes are among them: report on them, and neither learn nor choose.\n"
                if any(is_test(parse_seeds(each)[0]) for each in held) else "")
    surrogate = examples.surrogate
    sizes["which"] = TRUE if surrogate is None else ", of the surrogate"
    marked = "" if surrogate is None else SURROGATE.format(source=json.dumps(surrogate.source))
    command = (f"eitbench export --env {examples.env} --format {identity['format']} --out FOLDER "
               f"{'' if surrogate is None else _options(surrogate.source)}--seeds ")
    again = "\n".join(command + each for each in held)
    return f"""\
# {examples.env}: {'' if surrogate is None else 'surrogate '}episodes to learn from

Process tomography, simulated: currents injected through electrodes on a vessel's wall, the voltages
there, and the true concentration. One file an episode (`{identity['format']}`).

Episodes: {'; '.join(held) or 'none yet'}. Learn on `train`, choose on `dev`, report on `test`.
{reserved}{marked}
## Fields

{FIELDS.format(**sizes, **UNITS)}
`mesh.npz` holds the nodes (`points`, m), the cells, and the mass matrix M̃ in CSR form.

## Score

{EXACT if surrogate is None else OF_SURROGATE}

{SCORE.format(**sizes)}
## Where it comes from

eitbench {identity['eitbench']}, environment `{examples.env}`, code and libraries of digest
`{identity['digest'][:16]}`; no measured data, no persons. Made again by

```sh
{again}
```

Licence: MIT, as eitbench. All numbers of the world:

```json
{json.dumps(identity['world'], indent=1)}
```
""".encode()


def _options(source: Mapping[str, Any]) -> str:
    """Of the command, for such surrogate episodes."""
    return "--surrogate " + ("--model MODEL " if source.get("model") else "")


def ranges(files: Iterable[str]) -> list[str]:
    """``train:0-99,200`` and so on, of ``train-0``, ``train-1`` …"""
    numbers: dict[str, set[int]] = {}
    for name in files:
        split, _, number = name.rpartition("-")
        numbers.setdefault(split, set()).add(int(number))
    return [f"{split}:{_runs(each)}" if split else _runs(each)
            for split, each in sorted(numbers.items())]


def _runs(numbers: set[int]) -> str:
    begins = sorted(number for number in numbers if number - 1 not in numbers)
    ends = sorted(number for number in numbers if number + 1 not in numbers)
    return ",".join(str(a) if a == b else f"{a}-{b}" for a, b in zip(begins, ends, strict=True))
