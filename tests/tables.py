"""Contents of tables, for tests of cells and boards."""

import pandas as pd
from eitbench.bench.table import Table
from eitbench.report.boards import leaderboard_table, leaderboards


def said(table: Table) -> pd.DataFrame:
    """Return all cells as plain text under their headings."""
    return pd.DataFrame([[cell.plain_text for cell in row.cells] for row in table.rows], columns=table.headings)


def boards(records: list[dict]) -> pd.DataFrame:
    """Return the rows of all leaderboards."""
    return leaderboard_table(leaderboards(records))
