"""The mean of initial and trained weights."""

import pytest
import torch

from infgen.config import TrainSettings
from infgen.errors import ConfigError
from pipeline.stages.train.initial_share import mean_with_initial
from pipeline.stages.train.stage import reads


def test_what_was_trained_is_averaged_with_what_it_began_with():
    initial = {"weight": torch.tensor([0.0, 4.0])}
    trained = {"weight": torch.tensor([1.0, 0.0])}

    found = mean_with_initial(initial, trained, {"weight"}, 0.25)

    assert found["weight"].tolist() == [0.75, 1.0]
    assert trained["weight"].tolist() == [1.0, 0.0]


def test_what_was_not_trained_keeps_its_bits():
    fixed = torch.tensor([-0.0, 0.1])

    found = mean_with_initial({"fixed": fixed}, {"fixed": fixed.clone()}, {"fixed"}, 0.5)

    assert torch.signbit(found["fixed"]).tolist() == [True, False]
    assert torch.equal(found["fixed"], fixed)


def test_of_a_new_part_the_output_is_scaled():
    initial = {"new.inner": torch.tensor([0.3]), "new.last": torch.tensor([0.0])}
    trained = {"new.inner": torch.tensor([0.9]), "new.last": torch.tensor([2.0])}

    found = mean_with_initial(initial, trained, (), 0.75)

    assert found["new.inner"].item() == pytest.approx(0.9)
    assert found["new.last"].item() == pytest.approx(0.5)


def test_a_share_wants_weights_to_begin_with(tmp_path):
    how = {"train": TrainSettings(initial_share=0.5)}

    with pytest.raises(ConfigError, match=r"initial_share is 0\.5, but train\.initial_wei"):
        reads(tmp_path, how)
