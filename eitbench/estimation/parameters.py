"""Parameters of the stochastic evolution model, all in terms of the best homogeneous estimate (thesis Table 5.1)."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from eitbench.estimation.covariance import FreeCovariance
from eitbench.estimation.kalman import KalmanFilter

if TYPE_CHECKING:
    from eitbench.physics.transport import ConvectionDiffusion

INFLOW_STD = 1 / 4
"""std of the inflow noise η in parts of ĉ_bh [T]"""
NODAL_STD = 1 / 50
"""std of the nodal noise e in parts of ĉ_bh [ours; illegible in the table]"""
INITIAL_STD = 1 / 4
"""std of the initial state in parts of ĉ_bh [ours; illegible in the table]"""

TABLE_5_1 = {"inflow_std": INFLOW_STD, "nodal_std": NODAL_STD, "initial_std": INITIAL_STD}
"""For records."""


def table_5_1(transport: ConvectionDiffusion, c_bh: float) -> KalmanFilter:
    """A Kalman filter for c⁺ = F c + Y c_in + w with the parameters of Table 5.1.

    Inflow and initial state have mean ĉ_bh; Γ_η, Γ_e and Γ_{0|0} are diagonal. As all of them scale with ĉ_bh², the
    covariance without data is computed once for a transport model and serves every episode.

    Parameters
    ----------
    transport : ConvectionDiffusion
    c_bh : float
        Best homogeneous estimate in mol/m³.
    """
    F, Y, _ = transport.evolution_model()
    n = len(F)
    return KalmanFilter(F, Y.sum(axis=1) * c_bh, np.full(n, c_bh), _unit_covariance(transport).scaled(c_bh**2))


@lru_cache(maxsize=1)
def _unit_covariance(transport: ConvectionDiffusion) -> FreeCovariance:
    evolution = transport.evolution_model()
    return FreeCovariance(evolution.F, evolution.state_noise_covariance(INFLOW_STD**2, NODAL_STD**2),
                          INITIAL_STD**2 * np.eye(len(evolution.F)))
