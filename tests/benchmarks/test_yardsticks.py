"""Yardsticks of the SRL error: decoders that have learned nothing or little, beside what the paper reports."""

import pytest

from benchmarks import zero_decoder
from sb3_cure.experiments import yardsticks


def test_yardsticks_follow_an_autoencoder_from_its_first_update() -> None:
    """Untrained it errs like a prediction of zero, as the paper reports; then it learns. Rows make the table."""
    rows = yardsticks.measure_task("dmc_pixels/cartpole-swingup-v0", (0,), (0, 1, 6), 40, frame_stack=1)
    error = {(row["predictor"], row["updates"]): row["error_mean"] for row in rows}
    # .0518 +- .0005 was measured elsewhere from the renderer's pixels alone.
    assert error["zero", 0] == pytest.approx(0.0518, abs=0.001)
    assert error["autoencoder", 0] == pytest.approx(error["zero", 0], rel=0.1)
    assert error["mean_image", 0] < error["autoencoder", 6] < error["autoencoder", 0]
    *_, line = yardsticks.table(rows)
    numbers = [f"{error[key]:.4f}" for key in (("zero", 0), ("mean_image", 0), ("autoencoder", 0))]
    assert line.startswith(f"| cartpole-swingup | 0.0002 | 0.0540 | {' | '.join(numbers)} |")
    assert line.endswith(f"| {error['autoencoder', 6]:.4f} (6) |")


def test_zero_decoder_errs_alike_in_the_script_for_older_versions_of_mujoco() -> None:
    """Which shares no code with the rest, as nothing else runs there; its rows become a column of the same table."""
    (zero, *_) = yardsticks.measure_task("dmc_pixels/reacher-easy-v0", (0,), (0,), 20)
    error = zero_decoder.zero_error("reacher", "easy", action_repeat=4, seed=0, steps=20)
    assert error == pytest.approx(zero["error_mean"], rel=0.02)
    elsewhere = [
        {"mujoco": "2.3.2", "task": task, "seed": seed, "error_mean": error}
        for task, seed, error in (("reacher-easy", 0, 0.038), ("reacher-easy", 1, 0.040), ("other", 0, 1.0))
    ]
    row = {"task": "reacher-easy", "updates": 0, "seed": 0, "error_mean": 0.05}
    rows = [{**row, "predictor": name} for name in ("zero", "mean_image", "autoencoder")]
    header, _, line = yardsticks.table(rows, elsewhere)
    assert line.split(" | ")[header.split(" | ").index("zero, MuJoCo 2.3.2")] == "0.0390"
