#!/bin/bash
#SBATCH --nodes=4 --ntasks-per-node=1 --exclusive --gpus-per-node=1 --time=24:00:00
# A grid on Ray on whole nodes, from this repository's environment and with a folder that all nodes share:
#   sbatch zoo_configs/cluster/slurm.sh zoo_configs/experiments/curves.yml --out /shared/results \
#       --cpus-per-cell 4 --gpus-per-cell 0.25
# Without GPUs: sbatch --gpus-per-node=0 ..., without --gpus-per-cell. Stopped or out of time? Submit it again.
set -u
export MUJOCO_GL=${MUJOCO_GL:-egl}  # sbatch passes on a DISPLAY (of ssh -X, say) that no node can open
head=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
export address="${head:?SLURM does not name its nodes}:6379"
export RAY_AUTH_MODE=token RAY_AUTH_TOKEN=$(openssl rand -hex 32)  # else anyone on the network could run code in it

srun --cpus-per-task="$SLURM_CPUS_ON_NODE" --kill-on-bad-exit=1 bash -c '
    [ "$SLURM_PROCID" = 0 ] && role="--head --port=6379" || role="--address=$address"
    exec ray start $role --num-cpus "$SLURM_CPUS_ON_NODE" --block' > "ray-$SLURM_JOB_ID.log" 2>&1 &
ray=$!
while true; do
    timeout 60 ray status --address "$address" > /dev/null 2>&1 && break
    if (( SECONDS > 240 )) || ! kill -0 "$ray" 2> /dev/null; then
        echo "Ray did not start: see ray-$SLURM_JOB_ID.log"
        exit 1
    fi
    sleep 5
done
sb3-cure experiment "$@" --engine ray --address "$address"
