"""Four strangers' files, each as its tool writes it, up to the right name with few edits."""

import pytest

from tests.plant.strangers import STRANGERS, run

EDITS = 2  # at most, beside the options of `plant new`
# the quickest is in make test
CASES = [pytest.param(s, marks=[] if s.name == "motor" else pytest.mark.slow, id=s.name) for s in STRANGERS]


@pytest.mark.parametrize("stranger", CASES)
def test_a_strangers_file_up_to_the_right_name(stranger, tmp_path):
    lines, named = run(stranger, tmp_path)
    print("\n" + "\n".join(lines))
    assert named == [stranger.hidden] and len(stranger.edits) <= EDITS
