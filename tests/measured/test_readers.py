"""Readers on generated files of each format, and on public files where present."""

from hashlib import sha256

import numpy as np
import pytest
from eitbench.measured import read
from eitbench.measured.cases import read_case
from scipy.io import savemat
from scipy.sparse import csc_array
from tanks import instrument

CURRENTS, MATRIX = instrument()
VALUES = np.random.default_rng(0).normal(size=(8, 8))


def test_ktc(tmp_path):
    """Columns, here sparse ones, are injections and patterns; voltages are in the order of injections, in mA and V."""
    injections, patterns = csc_array(1e3 * CURRENTS.T), csc_array(MATRIX.T)
    values = VALUES.reshape(-1, 1)
    savemat(tmp_path / "data1.mat", {"Inj": injections, "Mpat": patterns, "Uel": values})
    savemat(tmp_path / "ref.mat", {"Injref": injections, "Mpat": patterns, "Uelref": 2 * values})
    measurements = read(tmp_path / "data1.mat")
    np.testing.assert_allclose(measurements.currents, CURRENTS, atol=1e-15)
    np.testing.assert_array_equal(measurements.matrix, MATRIX)
    np.testing.assert_array_equal(measurements.voltages, VALUES)
    np.testing.assert_array_equal(measurements.reference, 2 * VALUES[None])
    assert measurements.source["sha256"] == sha256((tmp_path / "data1.mat").read_bytes()).hexdigest()


def test_kit4(tmp_path):
    """Each column has the voltages of an injection; the reference is the file of the empty tank."""
    patterns = {"CurrentPattern": 1e3 * CURRENTS.T, "MeasPattern": MATRIX[:5].T}
    savemat(tmp_path / "datamat_2_1.mat", patterns | {"Uel": VALUES[:, :5].T})
    measurements = read(tmp_path / "datamat_2_1.mat")
    np.testing.assert_array_equal(measurements.voltages, VALUES[:, :5])
    assert measurements.reference is None
    savemat(tmp_path / "datamat_1_0.mat", patterns | {"Uel": 2 * VALUES[:, :5].T})
    np.testing.assert_array_equal(read(tmp_path / "datamat_2_1.mat").reference, 2 * VALUES[None, :, :5])


def test_eidors(tmp_path):
    """A frame has 256 numbers; measurements with an injecting electrode are missing. Variables are
    named if the names are not the usual ones, and must hold numbers."""
    frames = np.random.default_rng(1).uniform(1, 2, (256, 3))
    savemat(tmp_path / "usual.mat", {"v_rotate": frames, "v_reference": frames[:, :1]})
    path = tmp_path / "other.mat"
    savemat(path, {"mine": frames, "water": frames[:, :1], "text": "abc",
                   "cell": np.array([1, "a"], object)})
    for measurements in (read(tmp_path / "usual.mat"), read(path, name="mine", reference="water")):
        assert measurements.voltages.shape == (48, 16)
        assert np.isnan(measurements.voltages[17, [0, 1, 2]]).all()
        assert measurements.voltages[17, 5] == -frames[16 + 5, 1]
        assert measurements.reference.shape == (1, 16, 16)
    for options, message in (
            ({}, "one of mine, water"),
            ({"colour": 1}, "must be among name, reference, got colour"),
            ({"name": "text"}, "text must be a numeric array, got a character array"),
            ({"name": "cell"}, "cell must be a numeric array, got a cell array")):
        with pytest.raises(ValueError, match=message):
            read(path, **options)


def eit_file(path, potentials, *, second=0.0):
    """Write a Sciospec frame: peak amplitude 5 mA, adjacent electrodes."""
    L = potentials.shape[1]
    header = ["18", "2", path.stem, f"2025.02.12. 13:19:{second:06.3f}", "10000.0", "10000.0", "1",
              "1", "0.005", "20.0", "0.0", "1.0", "1", "1", "1", "1",
              "MeasurementChannels: " + ",".join(str(each) for each in range(1, L + 1)),
              "MeasurementChannelsIndependentFromInjectionPattern: 1,2"]
    body = []
    for k, row in enumerate(potentials):
        body += [f"{k + 1} {(k + 1) % L + 1}",
                 "\t".join(f"{part!r}" for each in row
                           for part in (float(each.real), float(each.imag)))]
    path.write_text("\n".join(header + body) + "\n", encoding="utf-8")


def test_sciospec(tmp_path):
    """Voltages are real parts relative to their mean; frames are in order."""
    values = np.random.default_rng(2).normal(size=(3, 8, 8)) * (1 + 0.1j)
    for f, frame in enumerate(values):
        eit_file(tmp_path / f"setup_0000{f}.eit", frame, second=0.05 * f)
    measurements = read(tmp_path)
    np.testing.assert_allclose(measurements.currents, 5 * CURRENTS)
    expected = values.real - values.real.mean(axis=2, keepdims=True)
    np.testing.assert_allclose(measurements.voltages, expected.reshape(-1, 8))
    np.testing.assert_allclose(measurements.times[[0, 8, 16]], [0.0, 0.05, 0.1], atol=1e-6)
    one = read(tmp_path / "setup_00001.eit")
    np.testing.assert_allclose(one.voltages, expected[1])


def test_truncated_frame_is_named(tmp_path):
    path = tmp_path / "setup_00001.eit"
    eit_file(path, np.ones((8, 8)))
    text = path.read_text(encoding="utf-8").strip()
    last = text.rindex("\n")
    for kept, message in ((text[:last], "hold blocks of lines"), (text[:last + 40], "hold blocks of lines"),
                          ("", "begin with the header")):
        path.write_text(kept, encoding="utf-8")
        with pytest.raises(ValueError, match=rf"setup_00001\.eit must {message}"):
            read(path)


def table(path, titles="", first="{:d}", decimal=".", separator=",", **description):
    """Write a table, and its description in a YAML file."""
    rows = [separator.join([first.format(k + 1), first.format((k + 1) % 8 + 1),
                            *[repr(float(each)).replace(".", decimal) for each in row]])
            for k, row in enumerate(VALUES)]
    path.write_text("\n".join([*[titles] * bool(titles), *rows]), encoding="utf-8")
    if description:
        lines = [f"{name}: {value}" for name, value in description.items()]
        path.with_suffix(".yml").write_text("\n".join(lines), encoding="utf-8")
    return path


def test_table(tmp_path):
    """A table of potentials in mV is described by a YAML file or by arguments."""
    measurements = read(table(tmp_path / "tank.csv", electrodes=8, current="1e-3", unit=0.001))
    np.testing.assert_allclose(measurements.currents, CURRENTS)
    np.testing.assert_allclose(measurements.voltages, 1e-3 * (VALUES - VALUES.mean(axis=1, keepdims=True)))
    comma = table(tmp_path / "comma.csv", decimal=",", separator=";")
    same = read(comma, electrodes=8, current=1e-3, unit=1e-3, decimal=",")
    np.testing.assert_array_equal(same.voltages, measurements.voltages)


def test_a_lost_potential_or_a_spike_does_not_shift_the_others(tmp_path):
    """Potentials are relative to the mean of all electrodes, also where one is missing, in a drifting instrument."""
    frames = np.concatenate([VALUES + drift for drift in (0.0, 3.0, -2.0, 0.5, 1.0, -40.0, 0.2)])
    expected = np.tile(VALUES - VALUES.mean(axis=1, keepdims=True), (7, 1))
    pairs = np.tile(np.stack([np.arange(8), (np.arange(8) + 1) % 8], axis=1) + 1, (7, 1))

    def read_rows(values):
        texts = np.where(np.isnan(values), "", values.astype(str))
        rows = [",".join([*map(str, pair), *row]) for pair, row in zip(pairs, texts, strict=True)]
        (tmp_path / "rows.csv").write_text("\n".join(rows), encoding="utf-8")
        return read(tmp_path / "rows.csv", electrodes=8, current=1.0).voltages

    np.testing.assert_allclose(read_rows(frames), expected, atol=1e-12)
    damaged, kept = frames.copy(), np.ones(frames.shape, dtype=bool)
    damaged[17, 1], damaged[30, 4] = np.nan, 100.0 * np.abs(VALUES).max()   # the first at an injecting electrode
    kept[[17, 30], [1, 4]] = False
    found = read_rows(damaged)
    np.testing.assert_allclose(found[kept], expected[kept], atol=1e-12)
    assert np.isnan(found[17, 1]) and found[30, 4] > 50.0 * np.abs(VALUES).max()


KTC = {"Inj": CURRENTS.T, "Mpat": MATRIX.T, "Uel": VALUES}
COMMA = {"electrodes": 8, "current": 1e-3, "decimal": ","}
"""Description of a table with decimal commas."""


@pytest.mark.parametrize(("content", "name", "options", "message"), [
    (None, "a.mat", {}, "got a missing path"),
    (b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(500), "a.mat", {},
     "`save -v7` writes: .*v7.3"),
    (b"MATLAB 5.0 MAT-file" + bytes(300), "a.mat", {}, r"a\.mat must"),
    ({"Inj": CURRENTS.T, "Uel": VALUES}, "a.mat", {}, "must hold Mpat, got"),
    (b"x", "a.jpg", {}, "must end in"),
    (KTC, "a.mat", {"format": "excel"}, "format must be one of"),
    (table, "comma.csv", {}, r"described by a YAML file.*comma\.yml"),
    (table, "comma.csv", COMMA | {"decimal": "."}, "numbers with the decimal point '.'"),
    (table, "comma.csv", COMMA | {"electrodes": 9}, "rows must have 11 columns"),
    (table, "comma.csv", COMMA | {"unit": "mV"}, "unit must be a number in V.*got 'mV'")])
def test_invalid_files_are_rejected(tmp_path, content, name, options, message):
    path = tmp_path / name
    if content is table:
        table(path, decimal=",", separator=";")
    elif isinstance(content, bytes):
        path.write_bytes(content)
    elif content:
        savemat(path, content)
    with pytest.raises(ValueError, match=message):
        read(path, **options)


@pytest.mark.parametrize(("case", "shape"), [
    ("ktc-1", (76, 31)), ("kit4-2.3", (79, 16)), ("iirc", (1600, 16)), ("montreal", (1584, 16)),
    ("sciospec-13.19.50", (1600, 16)), ("sciospec-13.21.48", (1600, 16))])
def test_real_files(case, shape):
    """Public files in $EITBENCH_MEASURED have their number of injections and channels."""
    try:
        measurements = read_case(case).measurements()
    except ValueError as error:
        pytest.skip(str(error))
    assert measurements.voltages.shape == shape


DESCRIPTION = {"electrodes": 8, "current": 0.001}


@pytest.mark.parametrize(("titles", "first"), [
    ("", "{:d}.000e+00"), ("source,sink," + ",".join(f"ch-{k}" for k in range(1, 9)), "{:d}"),
    ("I+,I-," + ",".join(f"U{k}" for k in range(1, 9)), "{:d}")])
def test_tables_of_potentials(tmp_path, titles, first):
    """Numbers with a decimal point are not titles, and a "-" in a title is not a difference."""
    plain = read(table(tmp_path / "plain.csv", **DESCRIPTION))
    other = read(table(tmp_path / "other.csv", titles, first, **DESCRIPTION))
    np.testing.assert_array_equal(other.voltages, plain.voltages)
    np.testing.assert_array_equal(other.matrix, np.eye(8))
    np.testing.assert_array_equal(other.currents, plain.currents)


def test_tables_of_differences(tmp_path):
    """Voltages are differences if titles name two electrodes, or by the description."""
    titles = "a,b," + ",".join(f"U{k + 1}-U{(k + 1) % 8 + 1}" for k in range(8))
    for titles_given, readings, expected in ((titles, {}, MATRIX), ("", {"readings": "neighbours"}, MATRIX),
                                             (titles, {"readings": "potentials"}, np.eye(8))):
        measurements = read(table(tmp_path / "a.csv", titles_given, **DESCRIPTION, **readings))
        np.testing.assert_array_equal(measurements.matrix, expected)
    with pytest.raises(ValueError, match="readings must be one of potentials, neighbours; got 'volts'"):
        read(table(tmp_path / "a.csv", **DESCRIPTION, readings="volts"))


def test_first_rows_may_be_the_reference(tmp_path):
    path = table(tmp_path / "a.csv", **DESCRIPTION)
    path.write_text("\n".join([path.read_text()] * 3))
    expected = VALUES - VALUES.mean(axis=1, keepdims=True)
    measurements = read(path, reference_rows=16, time_step=0.5)
    np.testing.assert_allclose(measurements.voltages, expected)
    np.testing.assert_allclose(measurements.reference, [expected] * 2)
    np.testing.assert_array_equal(measurements.times, 0.5 * np.arange(8))
    for rows in (3, 24):
        with pytest.raises(ValueError, match=f"reference_rows must be complete frames of .* injections, got {rows}"):
            read(path, reference_rows=rows)


def test_file_of_a_vessel_does_not_describe_a_table(tmp_path):
    table(tmp_path / "tank.csv", **DESCRIPTION)
    (tmp_path / "tank.yml").rename(tmp_path / "tank.csv.yml")
    (tmp_path / "tank.yml").write_text("kind: circle\nradius: 0.1\n")
    assert read(tmp_path / "tank.csv").voltages.shape == (8, 8)
    (tmp_path / "tank.csv.yml").unlink()
    with pytest.raises(ValueError, match=r"neither tank\.csv\.yml"):
        read(tmp_path / "tank.csv")


def test_sciospec_header_is_heeded(tmp_path):
    """Whole seconds, the differential mode and several frequencies."""
    file = tmp_path / "setup_00001.eit"
    eit_file(file, VALUES + 0j)
    lines = file.read_text().splitlines()
    lines[3] = "2025.02.12. 13:19:00"
    lines[13] = "2"
    file.write_text("\n".join(lines))
    differential = read(file)
    np.testing.assert_array_equal(differential.matrix, MATRIX)
    np.testing.assert_array_equal(differential.voltages, VALUES)
    lines[4:8] = ["1000.0", "5000.0", "0", "2"]
    body = [line for pair, numbers in zip(lines[18::2], lines[19::2], strict=True)
            for line in (pair, numbers, "\t".join(str(2 * float(each)) for each in numbers.split()))]
    file.write_text("\n".join(lines[:18] + body))
    np.testing.assert_allclose(read(file, frequency=5000).voltages, 2 * VALUES)
    np.testing.assert_array_equal(read(file, frequency=1000).voltages, VALUES)
    with pytest.raises(ValueError, match="from 1000 to 5000 Hz: frequency must be 1000 or 5000, got None"):
        read(file)
    lines[13] = "7"
    file.write_text("\n".join(lines))
    with pytest.raises(ValueError, match="measurement mode 1"):
        read(file)
