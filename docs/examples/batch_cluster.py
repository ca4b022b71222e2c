"""A Dask cluster of batch jobs, for `mauvecl ... --cluster scheduler.json`; ends with Ctrl-C or when it is terminated.

    python batch_cluster.py slurm --jobs 10 --queue astro --hours 12 &
    mauvecl detect study.toml --cluster scheduler.json --resume

Jobs that end, die or are taken back cost the shards in their hands, which others count again. Needs dask-jobqueue and
mauvecl[cluster] on every node.
"""

from __future__ import annotations

import argparse
import signal
from pathlib import Path

import dask_jobqueue
from dask_jobqueue.local import LocalCluster

#: By the batch system's name; `local` starts the jobs on this machine, to try the script.
CLUSTERS = {"slurm": dask_jobqueue.SLURMCluster, "pbs": dask_jobqueue.PBSCluster, "local": LocalCluster}


def main() -> None:
    """Start the scheduler and ask for the jobs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("system", choices=CLUSTERS)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--cores", type=int, default=32, help="of a job; one worker process each")
    parser.add_argument("--memory", default="64GB", help="of a job; a worker needs about 0.5 GB")
    parser.add_argument("--hours", type=int, default=12)
    parser.add_argument("--queue")
    parser.add_argument("--scheduler-file", type=Path, default=Path("scheduler.json"))
    parser.add_argument("--show", action="store_true", help="print the job script and end")
    given = parser.parse_args()
    # Before any thread starts: the signals wait for `sigwait` below.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    # What only batch systems understand.
    how = {} if given.system == "local" else {"queue": given.queue, "walltime": f"{given.hours}:00:00"}
    cluster = CLUSTERS[given.system](
        cores=given.cores,
        processes=given.cores,
        memory=given.memory,
        scheduler_options={"dashboard_address": ":0"},
        **how,
    )
    with cluster:
        if given.show:
            print(cluster.job_script())
            return
        cluster.scale(jobs=given.jobs)
        # Written whole: a reader finds a scheduler in it, or no file.
        partial = given.scheduler_file.with_suffix(".part")
        partial.write_text(f'{{"address": "{cluster.scheduler_address}"}}\n')
        partial.replace(given.scheduler_file)
        print(f"Scheduler at {cluster.scheduler_address}, in {given.scheduler_file}")
        try:
            signal.sigwait({signal.SIGINT, signal.SIGTERM})
        finally:
            given.scheduler_file.unlink(missing_ok=True)


if __name__ == "__main__":
    main()
