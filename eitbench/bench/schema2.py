"""Records of the format before, schema 2, as they would be written today.

There a record carried one ``source``, a digest of the library's text that decided whether it
counted; its version was always eight digits of the method's file; and ``kwargs`` held what an
environment was registered with too.
"""

from __future__ import annotations

from typing import Any

from eitbench.bench import tracks
from eitbench.bench.methods import own_files

NUMBER = 2


def upgraded(record: dict[str, Any]) -> tuple[dict[str, Any], str]:
    """A record of schema 2 as one of schema 3, not sealed, and the name its file had to have.
    ``ValueError`` if something is missing that the new record is made from."""
    try:
        name = tracks.record_name(record["environment"]["name"], record["method"],
                                  record["method_sha256"][:8], record["split"])
        return _upgraded(record), name
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(f"is not valid as one of schema {NUMBER}: {type(error).__name__}: "
                         f"{error}") from None


def _upgraded(record: dict[str, Any]) -> dict[str, Any]:
    kept = {key: value for key, value in record.items() if key not in ("source", "sha256")}
    environment = record["environment"]
    given = _given(environment)
    is_ours = record["official"] is True and record["method"] in own_files(environment["id"])
    return kept | {
        "schema": 3,
        "version": "v1" if is_ours else record["method_sha256"][:8],
        "environment": environment | {"kwargs": given,
                                      "name": tracks.named(environment["id"], given)},
        "runs": [run | {"source": record["source"]} for run in record["runs"]],
    }


def _given(environment: dict[str, Any]) -> dict[str, Any]:
    """Arguments that differ from what is registered."""
    if environment["name"] == environment["id"].replace("/", "-"):
        # The name said that nothing was given, whatever the id was registered with then.
        return {}
    return tracks.changed(environment["id"], environment["kwargs"])
