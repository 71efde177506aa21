"""`Mesh` under the name by which users import it; it is defined in `eitbench.numerics.mesh`."""

from eitbench.numerics.mesh import Mesh

__all__ = ["Mesh"]
