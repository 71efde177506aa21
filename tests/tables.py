"""Contents of tables, for tests of cells."""

import pandas as pd
from eitbench.bench.table import Table


def said(table: Table) -> pd.DataFrame:
    """Return all cells as plain text under their headings."""
    return pd.DataFrame([[cell.plain_text for cell in row.cells] for row in table.rows],
                        columns=table.headings)
