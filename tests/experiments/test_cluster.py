"""The files in `zoo_configs/cluster/` fit the package: one who copies them gets a running grid."""

import os
import re
import subprocess
from pathlib import Path

import yaml

from sb3_cure.experiments.run import main

ROOT = Path(__file__).parents[2]
CLUSTER = ROOT / "zoo_configs" / "cluster"


def pinned_ray() -> str:
    found = re.search(r"^ray==(\S+)$", (ROOT / "constraints.txt").read_text(), re.M)
    assert found
    return found[1]


def ray_job() -> dict:
    return yaml.safe_load((CLUSTER / "kubernetes.yml").read_text())


def test_image_and_manifest_have_the_ray_that_is_tested() -> None:
    """All of a cluster's processes need one version of Ray, and `pip install -c constraints.txt` decides which."""
    assert f"FROM rayproject/ray:{pinned_ray()}-py311" in (CLUSTER / "Dockerfile").read_text()
    assert ray_job()["spec"]["rayClusterSpec"]["rayVersion"] == pinned_ray()


def test_every_pod_mounts_the_claimed_volume_where_the_grid_writes() -> None:
    """A worker without the volume would write its cells where nobody finds them."""
    volume = yaml.safe_load((CLUSTER / "volume.yml").read_text())
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


def test_slurm_script_starts_ray_on_all_nodes_and_passes_the_grid_on(tmp_path: Path) -> None:
    """With stand-ins for SLURM's and Ray's commands: one head, the others join it by one token; no Ray, no waiting."""
    commands = {
        "scontrol": "printf 'node1\\nnode2\\n'",
        "srun": 'echo "$1 $2"; shift 2; for id in 0 1; do SLURM_PROCID=$id "$@"; done; '
        '[ -z "$RAY_FAILS" ] && /bin/sleep 5',
        # `ray status` answers when all nodes have begun.
        "ray": '[ -z "$RAY_FAILS" ] || exit 1; [ "$1" = status ] && exec test -e started1; touch started$SLURM_PROCID; '
        'echo "$@ $RAY_AUTH_MODE ${#RAY_AUTH_TOKEN}"',
        "sleep": "exec /bin/sleep 0.1",
        "sb3-cure": 'echo "$@ $RAY_AUTH_MODE ${#RAY_AUTH_TOKEN}"',
    }
    for name, script in commands.items():
        (tmp_path / name).write_text(f"#!/bin/bash\n{script}\n")
        (tmp_path / name).chmod(0o755)
    job = {"SLURM_JOB_NODELIST": "node[1-2]", "SLURM_CPUS_ON_NODE": "16", "SLURM_JOB_ID": "7"}
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"

    def submit(**more: str) -> subprocess.CompletedProcess:
        return subprocess.run(
            ["bash", CLUSTER / "slurm.sh", "grid.yml", "--out", "/shared/my results"],
            env={**os.environ, **job, "PATH": path, **more}, cwd=tmp_path, capture_output=True, text=True, timeout=60,
        )  # fmt: skip

    done = submit()
    assert done.stdout == "experiment grid.yml --out /shared/my results --engine ray --address node1:6379 token 64\n"
    assert (tmp_path / "ray-7.log").read_text().splitlines() == [
        "--cpus-per-task=16 --kill-on-bad-exit=1",
        "start --head --port=6379 --num-cpus 16 --block token 64",
        "start --address=node1:6379 --num-cpus 16 --block token 64",
    ]
    failed = submit(RAY_FAILS="yes")
    assert (failed.returncode, failed.stdout) == (1, "Ray did not start: see ray-7.log\n")
