"""Dask workers for `wasp run --backend dask` as Slurm jobs: one process and one thread each. Runs until it is stopped.

pip install 'wasp-cli[dask]' dask-jobqueue
"""

from __future__ import annotations

import argparse
import time

from dask_jobqueue import SLURMCluster


def main() -> None:
    """Start the scheduler here, ask Slurm for workers, and say where the scheduler listens."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=8, help="workers, each a job of its own")
    parser.add_argument("--queue", default=None, help="partition")
    parser.add_argument("--memory", default="8GB", help="of a worker")
    parser.add_argument("--walltime", default="24:00:00", help="of a job; a node that is lost with it runs again")
    parser.add_argument("--port", type=int, default=8786, help="of the scheduler")
    options = parser.parse_args()
    cluster = SLURMCluster(
        queue=options.queue,
        cores=1,  # one thread: a node sets threads, log and memory of its whole process
        processes=1,
        memory=options.memory,
        walltime=options.walltime,
        job_script_prologue=["export OMP_NUM_THREADS=1"],
        scheduler_options={"port": options.port},
    )
    cluster.scale(jobs=options.jobs)
    print(f"wasp run SPEC --backend dask --scheduler {cluster.scheduler_address}", flush=True)
    try:
        while True:
            time.sleep(60)
    except KeyboardInterrupt:
        cluster.close()


if __name__ == "__main__":
    main()
