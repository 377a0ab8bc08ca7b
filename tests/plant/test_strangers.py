"""Four strangers' files, each as its tool writes it, up to the right name with few edits."""

import pytest

from tests.plant.strangers import STRANGERS, run

EDITS = 2  # at most, beside the options of `plant new`


@pytest.mark.slow
@pytest.mark.parametrize("stranger", STRANGERS, ids=lambda s: s.name)
def test_a_strangers_file_up_to_the_right_name(stranger, tmp_path):
    lines, named = run(stranger, tmp_path)
    print("\n" + "\n".join(lines))
    assert named == [stranger.hidden] and len(stranger.edits) <= EDITS
