"""Public seeds: disjoint ranges, and text that names them."""

import warnings

import pytest
from eitbench.data.seeds import SPLITS, allow_test_seeds, format_seed, parse_seeds, warn_test_seeds
from hypothesis import given
from hypothesis import strategies as st

numbers = st.integers(0, 99_999)


def test_splits_are_disjoint():
    assert len(set().union(*SPLITS.values())) == sum(map(len, SPLITS.values()))


@given(st.integers(0, 2**31 - 1))
def test_names_are_parsed_back(seed):
    """`parse_seeds` undoes `format_seed` for every seed, inside and outside the splits."""
    assert parse_seeds(format_seed(seed)) == [seed]


@given(st.sampled_from(list(SPLITS)), st.lists(st.tuples(numbers, st.integers(0, 20)), min_size=1, max_size=5))
def test_parts_add_up_without_repeats(split, parts):
    """A list of ranges has each number once, in the order of first mention."""
    spans = [(first, min(first + more, 99_999)) for first, more in parts]
    text = f"{split}:" + ",".join(f"{first}-{last}" if last > first else f"{first}" for first, last in spans)
    expected = [SPLITS[split].start + i for first, last in spans for i in range(first, last + 1)]
    seeds = parse_seeds(text)
    assert len(seeds) == len(set(seeds))
    assert seeds == sorted(set(expected), key=expected.index)


@pytest.mark.parametrize(("text", "message"), [
    ("test:1,,2", "look like"), ("exam:3", "one of the splits"),
    ("test:4-1", "must increase"), ("dev:99999-100000", "stay below 100000"), (str(2**31), "stay below 2147483648"),
])
def test_errors_say_what_was_expected(text, message):
    """Other forms, unknown splits and numbers beyond a split are rejected with the text."""
    with pytest.raises(ValueError, match=message) as caught:
        parse_seeds(text)
    assert repr(text) in str(caught.value)


def test_evaluations_leave_other_warnings_unchanged():
    """No warning of test seeds appears within `allow_test_seeds`."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("default")
        for _ in range(2):
            with allow_test_seeds():
                warn_test_seeds([200_000])
            warnings.warn("the cache is full", stacklevel=1)
    assert [str(warning.message) for warning in said] == ["the cache is full"]
