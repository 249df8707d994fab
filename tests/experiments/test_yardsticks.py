"""What decoders err that have learned nothing or little: measured on real pixels, and shown beside the paper's."""

import numpy as np
import pandas as pd
import pytest

from benchmarks import yardsticks, zero_decoder


@pytest.mark.long
def test_autoencoder_leaves_zero_with_first_updates() -> None:
    """Untrained it errs like a prediction of zero, as the paper reports; then it learns."""
    rows = yardsticks.measure_task("dmc_pixels/cartpole-swingup-v0", (0,), (0, 1, 6), 40, frame_stack=1)
    error = {(row["predictor"], row["updates"]): row["error_mean"] for row in rows}
    # .0518 +- .0005 was measured elsewhere from the renderer's pixels alone.
    assert error["zero", 0] == pytest.approx(0.0518, abs=0.001)
    assert error["autoencoder", 0] == pytest.approx(error["zero", 0], rel=0.1)
    assert error["mean_image", 0] < error["autoencoder", 6] < error["autoencoder", 0]
    # The script for older versions of MuJoCo shares no code with the rest.
    alone = zero_decoder.constant_errors(zero_decoder.targets("cartpole", "swingup", 8, seed=0, steps=20))
    assert alone["zero"].mean() == pytest.approx(error["zero", 0], rel=0.02)
    assert (
        error["mean_image", 0] < alone["another frame"].mean() < alone["constant colour"].mean() < alone["zero"].min()
    )


def test_constant_decoders_err_as_by_hand() -> None:
    """Two pictures of one pixel and two channels."""
    errors = zero_decoder.constant_errors(np.array([[[[0.0, 1.0]]], [[[2.0, 1.0]]]]))
    np.testing.assert_allclose(errors["zero"], [0.5, 2.5])
    np.testing.assert_allclose(errors["constant colour"], [0.5, 0.5])  # (1, 1) is the best colour
    np.testing.assert_allclose(errors["another frame"], [2, 2])


def test_table_has_means_with_minima_and_maxima() -> None:
    """Seeds and versions of MuJoCo in rows of their own, tasks in columns; where nothing was measured, a dash."""
    columns = ("error_min", "error_mean", "error_max")
    own = [("mean_image", 0, (0.001, 0.002, 0.003)), ("autoencoder", 0, (0.05, 0.06, 0.07))]
    own += [("autoencoder", 4, (0.01, 0.02, 0.03)), ("autoencoder", 4, (0.02, 0.04, 0.05))]
    errors = pd.DataFrame(
        [
            {"task": "reacher-easy", "predictor": name, "updates": updates, **dict(zip(columns, numbers, strict=True))}
            for name, updates, numbers in own
        ]
    )
    elsewhere = pd.DataFrame(
        [
            {"mujoco": "2.3.2", "predictor": "zero", "task": task, **dict(zip(columns, numbers, strict=True))}
            for task, numbers in (("reacher-easy", (0.03, 0.038, 0.04)), ("reacher-easy", (0.035, 0.040, 0.05)))
        ]
    )
    table = yardsticks.table(errors, elsewhere).rows.set_index("mean (min to max)")[">reacher-easy"]
    assert table["zero, MuJoCo 2.3.2"] == "0.0390 (0.0300 to 0.0500)"
    assert table["paper's cure / zero, MuJoCo 2.3.2"] == "1.02"  # .0399
    assert table["autoencoder after 4 updates"] == "0.0300 (0.0100 to 0.0500)"
    assert table["updates until its error is below the paper's cure"] == "4"
