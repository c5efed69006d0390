#!/bin/sh
# Trains and ships both fusion models, from nothing: some two hours on two cores.
#
#   scripts/train/run.sh [WORK]      WORK: folder for data and checkpoints, default target/train; what is there already is kept
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

# A model learns from all measured scenes; its twin does without those of fold B, to be judged by them.
train() {
    [ -e "$work/$1.pt" ] || "$python" scripts/train/train.py "$work/data" "$work/$1.pt" --size "$2" --folds "$3" --steps "$4"
}
model() {
    train "$1-twin" "$1" A "$2" &
    train "$1" "$1" AB "$2"
    wait $!
    "$python" scripts/train/ship.py "$work/data" "$work/$1.pt" "models/$1" --twin "$work/$1-twin.pt" \
        --golden tests/golden/fusion/shipped --date "$(date -u +%F)"
}
model default 7000
model preview 2500
