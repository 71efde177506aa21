"""Earlier names of classes, fields and members, in stored keys and third-party classes."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from operator import attrgetter

STORED_NAMES = {
    "ResistiveDisc": "Ball", "JitteredArrivals": "OneInEach", "RandomFlow": "DrawnFlow",
    "DeadTimePoissonArrivals": "NowAndThen", "RandomWalkFlow": "WanderingFlow",
    "OppositeDiagonalPattern": "AcrossAndAslant", "RotatingRingPattern": "RingsInTurn",
    "SinglePairPattern": "OnePair", "TankOppositeDiagonalPattern": "AroundTheTank",
    "electrode_coverage": "electrode_cover",
    "truth_mesh_file": "fine_file", "truth_mesh_sha256": "fine_sha256",
    "model_mesh_file": "coarse_file", "model_mesh_sha256": "coarse_sha256",
    "coarse_grid_shape": "patches", "is_elongated": "is_long",
    "oscillation_range": "swing_range",
    "log_amplitude": "strength", "time_std": "duration", "transverse_std": "width",
    "radial_range": "reach", "dead_time": "interval", "mean_wait": "wait",
    "initial_radius_range": "start_radius", "max_centre_radius": "furthest", "min_gap": "gap",
    "concentration_ratio": "metal",
    "noise_relative_to_max": "noise_of_largest", "current_norm": "limit",
    "n_dead_range": "dead", "n_failing_range": "failing", "n_loose_range": "loose",
    "noise_mismatch": "untold_noise", "contact_impedance_spread": "contact_spread"}
"""Name of a class or field -> its name in stored keys, which must not change.

Keys of cached files and identities of records are digests of these names."""
MEMBERS = {
    "transport_mesh": "carrier", "n_truth_steps": "parts_of_a_step",
    "coarse_grid_shape": "patches", "is_elongated": "is_long",
    "transverse_coordinates": "across", "sample_inlet_points": "draw_places",
    "laminar_velocity": "laminar", "n_mesh_lines": "lines",
    "assumed_velocity": "believed", "residence_steps": "flush_steps", "spin_up_steps": "lead_in",
    "is_advected": "is_carried", "is_stationary": "stands_still"}
"""Member of a vessel, flow or target -> its earlier name, which third-party classes may define."""


def stored_names(kind: type) -> dict[str, str]:
    """Return the name in stored keys of each field; third-party classes' fields keep theirs."""
    builtin = {each.name for base in kind.__mro__ if is_builtin(base) and is_dataclass(base)
               for each in fields(base)}
    return {each.name: STORED_NAMES.get(each.name, each.name) if each.name in builtin else each.name
            for each in fields(kind)}


def is_builtin(kind: type) -> bool:
    """Return whether a class is part of this package."""
    return kind.__module__.partition(".")[0] == "eitbench"


def add_current_members(kind: type) -> None:
    """Add the present names of members that a third-party class defines under earlier names."""
    for each in kind.__mro__:
        defined = {*vars(each), *vars(each).get("__annotations__", {})}
        for new, old in MEMBERS.items():
            if old in defined and new not in defined and not is_builtin(each):
                setattr(each, new, property(attrgetter(old)))
