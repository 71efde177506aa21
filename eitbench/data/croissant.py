"""Croissant 1.1 metadata of an exported data set, with fields on responsible AI (RAI 1.0)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from datetime import date
from pathlib import Path
from typing import Any

TERMS = ("arrayShape", "citeAs", "column", "containedIn", "equivalentProperty", "extract", "field",
         "fileObject", "fileProperty", "fileSet", "format", "includes", "isArray", "isLiveDataset",
         "jsonPath", "key", "md5", "parentField", "path", "recordSet", "references", "regex",
         "repeated", "replace", "samplingRate", "separator", "source", "subField", "transform")
CONTEXT = {term: f"cr:{term}" for term in TERMS} | {
    "@language": "en", "@vocab": "https://schema.org/", "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/", "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/", "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"}}
"""The context that readers of Croissant expect."""
RAI = {
    "rai:dataCollection": "Simulated: finite elements for the transport and for the complete "
                          "electrode model on meshes that estimators do not use, with additive "
                          "Gaussian measurement noise.",
    "rai:dataCollectionType": "Simulations",
    "rai:dataUseCases": "Training and selection of state estimators in process tomography on the "
                        "splits train and dev; reporting of scores on the split test.",
    "rai:dataLimitations": "One vessel, one flow model and one instrument; distributions of the "
                           "target are stated in dataset.json. Real instruments have other errors.",
    "rai:dataBiases": "The targets of all splits have one distribution.",
    "rai:personalSensitiveInformation": "None: no measured and no personal data."}


def croissant(about: dict[str, Any], files: Iterable[Path],
              fields: dict[str, tuple[str, str, str]]) -> bytes:
    """Return the metadata as JSON-LD, dated today.

    ``about`` are the common properties of an export, ``files`` its files, ``fields`` maps the names
    of arrays to shape, unit and meaning.
    """
    formats = {".npz": "application/x-npz", ".h5": "application/x-hdf5",
               ".json": "application/json"}
    distribution = [{
        "@type": "cr:FileObject", "@id": path.name, "name": path.name, "contentUrl": path.name,
        "contentSize": f"{path.stat().st_size} B", "encodingFormat": formats[path.suffix],
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest()} for path in sorted(files)]
    columns = ("name", "shape", "unit", "meaning")
    arrays = {
        "@type": "cr:RecordSet", "@id": "arrays", "name": "arrays",
        "description": "Arrays in the file of each episode.",
        "field": [{"@type": "cr:Field", "@id": f"arrays/{name}", "name": f"arrays/{name}",
                   "dataType": "sc:Text"} for name in columns],
        "data": [dict(zip((f"arrays/{column}" for column in columns), (name, *texts), strict=True))
                 for name, texts in fields.items()]}
    name = about["environment"].replace("/", "-")
    return json.dumps({
        "@context": CONTEXT, "@type": "sc:Dataset", "name": name,
        "conformsTo": ["http://mlcommons.org/croissant/1.1",
                       "http://mlcommons.org/croissant/RAI/1.0"],
        "description": f"Simulated episodes of {about['environment']}: currents, voltages and true "
                       "concentrations of electrical impedance tomography.",
        "license": "https://spdx.org/licenses/MIT", "datePublished": date.today().isoformat(),
        "creator": {"@type": "sc:Organization", "name": "The eitbench authors"},
        "version": about["eitbench"], "isLiveDataset": False,
        "citeAs": f"The eitbench authors: {name}, made by eitbench {about['eitbench']}",
        "url": "./", **RAI, "distribution": distribution, "recordSet": [arrays]},
        indent=1, ensure_ascii=False).encode()
