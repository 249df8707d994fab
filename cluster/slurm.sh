#!/bin/bash
#SBATCH --nodes=4 --ntasks-per-node=1 --cpus-per-task=16 --gpus-per-node=1 --time=24:00:00 --exclusive
# A grid on Ray on all nodes of a job, from this repository's environment and with a folder that all nodes share:
#   sbatch cluster/slurm.sh zoo_configs/experiments/curves.yml --out /shared/results --cpus-per-cell 4 --gpus-per-cell 0.25
# Without GPUs: sbatch --gpus-per-node=0 ..., without --gpus-per-cell. Stopped or out of time? Submit it again.
head=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
export address="$head:6379" SRUN_CPUS_PER_TASK="$SLURM_CPUS_PER_TASK"
export RAY_AUTH_MODE=token RAY_AUTH_TOKEN=$(openssl rand -hex 32)  # else anyone on the network could run code in it

srun bash -c '[ "$SLURM_PROCID" = 0 ] && role="--head --port=6379" || role="--address=$address"
    exec ray start $role --num-cpus "$SLURM_CPUS_PER_TASK" --block' > "ray-$SLURM_JOB_ID.log" 2>&1 &
until ray status --address "$address" > /dev/null 2>&1; do
    kill -0 $! 2> /dev/null || { echo "Ray did not start: see ray-$SLURM_JOB_ID.log"; exit 1; }
    sleep 5
done
sb3-cure experiment "$@" --engine ray --address "$address"
