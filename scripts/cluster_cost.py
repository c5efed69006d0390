#!/usr/bin/env python3
"""A session solved again by one worker and by two: time on the clock, processor time of the workers, load of the machine, and the same bits.

    scripts/cluster_cost.py [--program target/release/stokescope] [--frames 24] [--iterations 20] [--workers 1 2]

Needs the package of crates/python and dask.distributed. Where other programs use the cores, time on the clock says nothing; that the
processor time does not grow says that workers do not hinder each other. Exit code 1 where bits differ.
"""

import argparse
import hashlib
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from dask.distributed import Client, LocalCluster

import stokescope as ss


def used():
    found = resource.getrusage(resource.RUSAGE_SELF)
    return found.ru_utime + found.ru_stime


def digest(array):
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted((array / "0/c").rglob("0")) if path.is_file())).hexdigest()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default="target/release/stokescope")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--iterations", type=int, default=20)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args()
    found = set()
    with tempfile.TemporaryDirectory() as folder:
        recorded = Path(folder) / "recorded"
        subprocess.run(
            [options.program, "run", "--board", "x86-sim", "--no-preview", "--frames", str(options.frames), "--iterations", "2", "--out",
             Path(folder) / "out", "--record", recorded], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
        session = ss.Session(recorded)
        for workers in options.workers:
            out = Path(folder) / f"{workers}.ome.zarr"
            with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster, Client(cluster) as client:
                client.wait_for_workers(workers)
                before, start = sum(client.run(used).values()), time.perf_counter()
                ss.reprocess(session, client, out=out, iterations=options.iterations, block=2)
                seconds, processor = time.perf_counter() - start, sum(client.run(used).values()) - before
            found.add(digest(out))
            print(f"{workers} worker(s): {len(session)} frames, {seconds:.1f} s, {processor:.1f} s of processor time, "
                  f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores", flush=True)
    print("the same bits" if len(found) == 1 else "bits differ")
    return int(len(found) != 1)


if __name__ == "__main__":
    sys.exit(main())
