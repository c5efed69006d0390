#!/bin/sh
# Trains and ships both fusion models, from nothing: some two hours on two cores.
#
#   scripts/train/run.sh [WORK]      WORK: folder for data and checkpoints, default target/train
#
# $STOKESCOPE_SCENES: a folder of measured scenes (see Measured in scenes.py), ../shared/data where that exists. Without one the
# networks learn from procedural scenes alone and there is nothing to judge them by. Seeded; the order of sums inside PyTorch is
# its own, so that weights agree to a few digits only.
set -eu
cd "$(dirname "$0")/../.."
work=${1:-target/train}
scenes=${STOKESCOPE_SCENES:-../shared/data}
mkdir -p "$work"
[ -x "$work/venv/bin/python" ] || python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet -r scripts/train/requirements.txt
python=$work/venv/bin/python
export OMP_NUM_THREADS=1 OMP_WAIT_POLICY=passive OPENBLAS_NUM_THREADS=1
cargo build --release --example frames
set --
[ -d "$scenes" ] && set -- --scenes "$scenes"
"$python" scripts/train/captures.py "$work/data" --solver target/release/examples/frames "$@"
train() { "$python" scripts/train/train.py "$work/data" "$@"; }
ship() {
    "$python" scripts/train/ship.py "$work/data" "$@" --golden tests/golden/fusion/shipped --date "$(date -u +%F)"
}
# Half of the training on everyday scenes, half on all with the reflecting ones; once without the scenes of fold B, to be judged by
# them, and once with them, to be shipped.
train "$work/first.pt" --folds A --groups 118
train "$work/twin.pt" --folds A --start "$work/first.pt" --rate 1e-3 --steps 5000 &
train "$work/default.pt" --folds AB --start "$work/first.pt" --rate 1e-3 --steps 5000
wait $!
ship "$work/default.pt" models/default --twin "$work/twin.pt"
train "$work/preview.pt" --size preview --folds A --steps 2500
ship "$work/preview.pt" models/preview
