#!/usr/bin/env python3
"""The cost of a frame in a batch against the pipeline's own, in processor time of one thread, which other programs do not change much.

    scripts/batch_cost.py [--program target/release/stokescope] [--frames 200] [--size 250] [--iterations 10] [--repeats 2]

Needs the package of crates/python from the same build. A batch may cost 1.1 times its frames, and planning once; exit code 1 otherwise.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import stokescope as ss


def used(who):
    found = resource.getrusage(who)
    return found.ru_utime + found.ru_stime


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default="target/release/stokescope")
    for name, value in [("frames", 200), ("size", 250), ("iterations", 10), ("repeats", 2)]:
        parser.add_argument(f"--{name}", type=int, default=value)
    options = parser.parse_args()
    ratios = []
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "made"

        def run(*args):
            before = used(resource.RUSAGE_CHILDREN)
            subprocess.run([options.program, *map(str, args)], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            return used(resource.RUSAGE_CHILDREN) - before

        def batch(pattern):
            return run("reconstruct", "--calibration", made, "--raw", f"{made}/raw/{pattern}", "--guide", f"{made}/guide/{pattern}",
                       "--out", Path(folder) / "out", "--threads", 1, "--iterations", options.iterations, "--fusion", "off", "--force")

        run("simulate", "--size", options.size, "--frames", options.frames, "--surround", 0, "--guide-margin", 0, "--out", made)
        raws, guides = ([ss.read(path) for path in sorted((made / kind).glob("*.npy"))[:20]] for kind in ("raw", "guide"))
        solve = ss.Pipeline(ss.Device.load(made), iterations=options.iterations, fusion="off", threads=1)
        solve(raws[0], guides[0])
        for _ in range(options.repeats):
            start = used(resource.RUSAGE_SELF)
            for raw, guide in zip(raws, guides):
                solve(raw, guide)
            frame = (used(resource.RUSAGE_SELF) - start) / len(raws)
            planning = batch("00000[0].npy") - frame
            whole = batch("*.npy")
            ratios.append((whole - planning) / options.frames / frame)
            print(f"frame {1000 * frame:.1f} ms, start and planning {1000 * planning:.0f} ms, {options.frames} frames {whole:.1f} s: {ratios[-1]:.3f} times")
    ratio = sorted(ratios)[len(ratios) // 2]
    print(f"a frame of a batch costs {ratio:.3f} times the pipeline's own, allowed: 1.1")
    return int(ratio > 1.1)


if __name__ == "__main__":
    sys.exit(main())
