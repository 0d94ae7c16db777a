"""What fuzzing has found stays mended: each input is read again, without a fuzzer."""

import pytest

from tests.fuzz.target import CORPUS, all_targets

TARGETS = {target.name: target for target in all_targets()}
KEPT = [(name, path) for name, target in TARGETS.items() for path in target.kept()]


@pytest.mark.parametrize("name", TARGETS)
def test_seeds_are_read(name, tmp_path):
    """What the program writes itself is taken, or refused in words (a filter of one line)."""
    answers = [TARGETS[name].read(seed, tmp_path) for seed in TARGETS[name].module.seeds(tmp_path)]
    assert answers and any(answer is None for answer in answers), answers


@pytest.mark.parametrize(
    ("name", "path"), KEPT, ids=[f"{path.parent.name}/{path.name}" for _, path in KEPT]
)
def test_what_was_found_is_told_in_words(name, path, tmp_path):
    TARGETS[name].read(path.read_bytes(), tmp_path)  # raises what is no complaint of ours


def test_everything_that_is_kept_belongs_to_a_target_that_tells_what_it_reads():
    assert {folder.name for folder in CORPUS.iterdir() if folder.is_dir()} <= set(TARGETS)
    assert KEPT
    assert all(target.about for target in TARGETS.values())


#: A composition for each change.
_LONG = ("option", "overrides")


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] if n in _LONG else []) for n in TARGETS]
)
def test_a_cut_or_changed_seed_is_told_in_words(name, tmp_path):
    """A few hundred changes that need no fuzzer: cut, doubled, one byte another."""
    target = TARGETS[name]
    for seed in list(target.module.seeds(tmp_path))[:2]:
        steps = max(1, len(seed) // 6)
        for at in range(0, len(seed), steps):
            changed = bytes([seed[at] ^ 0x80])
            for data in (seed[:at], seed[:at] + changed + seed[at + 1 :], seed[:at] + seed):
                target.read(data, tmp_path)
