"""The files in `cluster/` fit the package: one who copies them gets a running grid."""

import re
from pathlib import Path

import yaml

from sb3_cure.experiments.run import main

ROOT = Path(__file__).parent.parent
CLUSTER = ROOT / "cluster"


def pinned_ray() -> str:
    found = re.search(r"^ray==(\S+)$", (ROOT / "constraints.txt").read_text(), re.M)
    assert found
    return found[1]


def ray_job() -> dict:
    volume, job = yaml.safe_load_all((CLUSTER / "kubernetes.yml").read_text())
    assert (volume["kind"], job["kind"]) == ("PersistentVolumeClaim", "RayJob")
    return job


def test_image_and_manifest_have_the_ray_that_is_tested() -> None:
    """All of a cluster's processes need one version of Ray, and `pip install -c constraints.txt` decides which."""
    assert f"FROM rayproject/ray:{pinned_ray()}-py311" in (CLUSTER / "Dockerfile").read_text()
    assert ray_job()["spec"]["rayClusterSpec"]["rayVersion"] == pinned_ray()


def test_every_pod_mounts_the_claimed_volume_where_the_grid_writes() -> None:
    """A worker without the volume would write its cells where nobody finds them."""
    volume = next(yaml.safe_load_all((CLUSTER / "kubernetes.yml").read_text()))
    cluster = ray_job()["spec"]["rayClusterSpec"]
    out = Path(re.search(r"--out (\S+)", ray_job()["spec"]["entrypoint"])[1])
    for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
        pod = group["template"]["spec"]
        (container,) = pod["containers"]
        claims = {v["name"]: v["persistentVolumeClaim"]["claimName"] for v in pod["volumes"]}
        mounts = {Path(m["mountPath"]): claims[m["name"]] for m in container["volumeMounts"]}
        assert any(mount in out.parents for mount in mounts)
        assert set(mounts.values()) == {volume["metadata"]["name"]}


def test_grids_command_of_the_manifest_is_understood(tmp_path: Path, capsys) -> None:
    """Its options are those of `sb3-cure experiment`, and the image has its grid where the Dockerfile copies it."""
    program, command, *arguments = ray_job()["spec"]["entrypoint"].split()
    assert (program, command) == ("sb3-cure", "experiment")
    copied = Path(re.search(r"^COPY --chown=ray \. (\S+)$", (CLUSTER / "Dockerfile").read_text(), re.M)[1])
    grid = ROOT / Path(arguments[0]).relative_to(copied)
    arguments[arguments.index("--out") + 1] = str(tmp_path)
    assert main([str(grid), *arguments[1:], "--dry-run"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 60
