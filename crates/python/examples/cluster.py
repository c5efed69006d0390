"""Solves a recorded session again on a Slurm cluster, or on this machine.

    pip install ./crates/python[cluster] dask-jobqueue
    python cluster.py SESSION OUT.ome.zarr --iterations 60 --workers 20 --queue short
    python cluster.py SESSION OUT.ome.zarr --local 2

SESSION and OUT lie on a disk that all nodes see. Started again after a time limit or a crash, it goes on with the frames that are missing.
Other schedulers: dask_jobqueue has PBSCluster, LSFCluster, SGECluster of the same interface; dask_kubernetes has KubeCluster.
"""

import argparse
import time

import stokescope as ss
from dask.distributed import Client


def cluster(options: argparse.Namespace):
    if options.local:
        from dask.distributed import LocalCluster

        return LocalCluster(n_workers=options.local, threads_per_worker=1, dashboard_address=None)
    from dask_jobqueue import SLURMCluster

    # one process a core: frames do not depend on each other, and one thread each wastes no core
    made = SLURMCluster(queue=options.queue, cores=options.cores, processes=options.cores, memory=f"{2 * options.cores} GB", walltime=options.walltime)
    made.scale(jobs=options.workers)
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("session")
    parser.add_argument("out")
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--workers", type=int, default=4, help="jobs of the cluster")
    parser.add_argument("--cores", type=int, default=8, help="cores of a job")
    parser.add_argument("--queue", default=None)
    parser.add_argument("--walltime", default="01:00:00")
    parser.add_argument("--local", type=int, default=0, metavar="N", help="N processes of this machine instead")
    options = parser.parse_args()
    with cluster(options) as made, Client(made) as client:
        if options.local:
            client.wait_for_workers(options.local)
        start = time.perf_counter()
        done = ss.reprocess(options.session, client, out=options.out, iterations=options.iterations)
    seconds = time.perf_counter() - start
    print(f"{done['solved']} of {done['frames']} frames in {seconds:.1f} s, {done['kept']} were there")


if __name__ == "__main__":
    main()
