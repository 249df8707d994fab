"""Crash reports of models that see dictionaries."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch as th
from dictionaries_for_tests import sensor_model

from sb3_cure.cure.crash_report import NonFiniteError
from sb3_cure.data.samples import Samples
from sb3_cure.srl import RAE, SRLOutput


class Broken(RAE):
    """Its loss is not finite from some update on."""

    def loss(self, batch: Samples, latents: th.Tensor, next_latents: th.Tensor | None = None) -> SRLOutput:
        loss, error = super().loss(batch, latents)
        return SRLOutput(loss * th.nan, error)


def test_crash_report_holds_every_key(tmp_path: Path) -> None:
    with pytest.raises(NonFiniteError) as caught:
        sensor_model(srl=Broken).learn(14)
    folder = Path(caught.value.crash_report)
    assert json.loads((folder / "report.json").read_text())["source"] == "srl"
    with np.load(folder / "batch.npz") as arrays:
        assert {"observations.front", "observations.joints", "next_observations.wrist", "views.wrist", "rewards"} <= {
            *arrays.keys()
        }
