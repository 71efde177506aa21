"""The fast way to read a record and the careful one are of one opinion."""

import json
import random
import struct

import jsonschema
from eitbench.bench import quick, records
from eitbench.bench.records import SCHEMA, read_record, write_record

import hostile
from tiny import record


def carefully(path):
    """What the careful way reads; None if it refuses the file."""
    try:
        return records._carefully(path)[0]
    except (OSError, ValueError):
        return None


def test_on_a_folder_of_strangers(tmp_path):
    """What is read fast is what is read carefully, and honest files as our writer leaves them are read fast."""
    hostile.folder_of(tmp_path, 150, seed=5)
    for path in sorted(tmp_path.iterdir()):
        fast = quick.quickly(path, SCHEMA)
        assert fast is None or json.dumps(fast) == json.dumps(json.loads(path.read_text()))
        careful = carefully(path)
        if careful is not None and careful["environment"]["id"].isascii():
            assert quick.quickly(write_record(tmp_path / "again", careful), SCHEMA) == careful
        if fast is not None:
            wrong = records.contradictions(fast) or records._too_many(fast)
            assert careful == fast or (careful is None and wrong)


def test_another_validator_judges_the_same():
    """Whatever is changed in a record: what fits, jsonschema has nothing against."""
    schema = jsonschema.Draft202012Validator(json.loads(quick.schema_text()))
    chance, agreed = random.Random(1), [0, 0]
    for i in range(150):
        made = hostile.hostile(chance, hostile.honest(chance, i)) if i % 3 else hostile.honest(chance, i)
        valid = isinstance(made, dict) and not records._too_many(made) and schema.is_valid(made)
        fits = quick.validator().is_valid(made)
        assert valid or not fits
        agreed[fits == valid] += 1
    assert agreed[1] > 145


def test_numbers_of_every_size(tmp_path):
    """However small or large: our writer's files are read fast, with other digits they are not."""
    chance = random.Random(2)
    sizes = [struct.unpack("<d", chance.randbytes(8))[0] for _ in range(400)]
    sizes += [chance.random() * 10.0**k for k in range(-12, 20) for _ in range(5)]
    numbers = [value for value in sizes if value == value and abs(value) != float("inf")]
    made = record("mine", [0.1], parameters={"all": [*numbers, 0, -0.0, 2**52, 1e-5, 9.9e-5, 1e16, "1e-5", "a,1e-7]"]})
    path = write_record(tmp_path, made)
    text = path.read_text()
    assert carefully(path) == made
    for i, number in enumerate(numbers):
        each = write_record(tmp_path, record("mine", [0.1], parameters={"one": number, "text": "a, b: c"}))
        assert (quick.quickly(each, SCHEMA) is not None) or i < 0 or "0.0000" in repr(number), number
    path.write_text(text.replace('"run": 0', '"run": 0.0'))
    assert quick.quickly(path, SCHEMA) is None
    large = write_record(tmp_path, record("mine", [0.1], parameters={"one": 2**60}))
    assert quick.quickly(large, SCHEMA) is None and read_record(large)["parameters"] == {"one": 2**60}
