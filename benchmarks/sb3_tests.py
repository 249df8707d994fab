"""Run SB3's own tests of SAC with CuReSAC in SAC's place, and write down which pass.

python -m benchmarks.sb3_tests path/to/stable-baselines3 --out results/robustness (a checkout of about the installed
version; a quarter of an hour)

Tests of what CuReSAC does otherwise by design fail: gSDE, ``share_features_extractor``, SB3's n-step buffer, images
standardised by ``VecNormalize``; and those that read SB3's policy classes, whose actors and critics have encoders of
their own. The installed SB3 is tested, and of the checkout only the folder ``tests`` is read.
"""

import argparse
import csv
import shutil
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import stable_baselines3
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN

from sb3_cure import CuReSAC
from sb3_cure.data.observations import image_spaces

#: SAC's defaults, and no extras
DEFAULTS: dict[str, Any] = dict(
    learning_rate=3e-4, buffer_size=1_000_000, learning_starts=100, batch_size=256, tau=0.005, gradient_steps=1,
    ent_coef="auto", srl=None, curiosity=None, actor_update_interval=1, target_update_interval=1, ent_coef_lr_factor=1,
    encoder_tau=0.005,
)  # fmt: skip


class SAC(CuReSAC):
    """CuReSAC without extras, with SAC's defaults; it trusts the files of its tests."""

    def __init__(self, policy: Any, env: Any, **kwargs: Any):
        has_images = policy == "MultiInputPolicy" and env is not None and bool(image_spaces(env.observation_space))
        extractor = NatureCNN if policy == "CnnPolicy" else CombinedExtractor if has_images else FlattenExtractor
        defaults = {"net_arch": [256, 256], "features_extractor_class": extractor}
        policy_kwargs = defaults | (kwargs.get("policy_kwargs") or {})
        super().__init__(policy, env, **{**DEFAULTS, **kwargs, "policy_kwargs": policy_kwargs})

    def load_replay_buffer(self, *args: Any, **kwargs: Any) -> None:
        """Load a replay buffer.

        :param args: As of CuReSAC
        :param kwargs: As of CuReSAC
        """
        super().load_replay_buffer(*args, trusted=True, **kwargs)


class TestsOfSAC:
    """Pytest plugin that keeps the tests of SAC and notes what comes of them."""

    def __init__(self) -> None:
        #: Outcome and last line of the error of each test
        self.outcomes: dict[str, tuple[str, str]] = {}

    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Deselect the tests of other algorithms.

        :param config: Settings of pytest
        :param items: All tests
        """
        items[:] = [item for item in items if _is_about_sac(item)]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note the outcome of a test, or of its set-up where that fails.

        :param report: What came of it
        """
        if report.when == "call" or not report.passed:
            crash = getattr(report.longrepr, "reprcrash", None)
            reason = crash.message.splitlines()[0] if crash and crash.message else ""
            self.outcomes[report.nodeid] = (report.outcome, reason)


def _is_about_sac(item: Any) -> bool:
    """Whether a parameter of the test is SAC or, if it is given no algorithm, its code names SAC."""
    given = dict(item.callspec.params) if hasattr(item, "callspec") else {}
    algorithms = [each for each in given.values() if isinstance(each, type) and issubclass(each, BaseAlgorithm)]
    if algorithms or "model_name" in given:
        return SAC in algorithms or given.get("model_name") == "sac"
    return "SAC" in item.function.__code__.co_names


def main() -> None:
    """Run the tests and write ``sb3_tests.csv``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path, help="folder of a checkout of stable-baselines3")
    parser.add_argument("--out", type=Path, default=Path("results/robustness"), help="folder to write")
    parser.add_argument("-k", default="", help="names of tests, as of pytest")
    options = parser.parse_args()
    th.set_num_threads(1)
    stable_baselines3.SAC = SAC  # type: ignore[misc, assignment]
    plugin = TestsOfSAC()
    with tempfile.TemporaryDirectory() as folder:
        # Beside its tests pytest would import the checkout's own package.
        shutil.copytree(options.checkout / "tests", Path(folder, "tests"))
        quiet = ["-q", "--tb=no", "-p", "no:cacheprovider", "-W", "ignore"]
        files = [str(path) for path in Path(folder, "tests").glob("test_*.py") if "SAC" in path.read_text()]
        pytest.main([*quiet, f"--rootdir={folder}", "-k", options.k, *files], plugins=[plugin])
    options.out.mkdir(parents=True, exist_ok=True)
    with open(options.out / "sb3_tests.csv", "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["test", "outcome", "reason"])
        writer.writerows([name, *outcome] for name, outcome in sorted(plugin.outcomes.items()))
    print(dict(Counter(outcome for outcome, _ in plugin.outcomes.values())))


if __name__ == "__main__":
    main()
