#!/bin/sh
# Trains and ships both fusion models, from nothing: some two hours and a half on two cores.
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

"$python" scripts/train/train.py "$work/data"

# train RUN SIZE FOLDS STEPS [OPTION ...]; what is there is kept
train() {
    run=$work/$1.pt size=$2 folds=$3 steps=$4
    shift 4
    [ -e "$run" ] || "$python" scripts/train/train.py "$work/data" "$run" --size "$size" --folds "$folds" --steps "$steps" "$@"
}
# A model learns from all measured scenes; its twin does without those of fold B, to be judged by them.
# pair RUN SIZE STEPS [RUN [OPTION ...]]: both, side by side, from nothing or going on from another pair
pair() {
    run=$1 size=$2 steps=$3 from=${4:-}
    shift "$(($# > 4 ? 4 : $#))"
    train "$run-twin" "$size" A "$steps" ${from:+--start "$work/$from-twin.pt" --seed 2} "$@" &
    train "$run" "$size" AB "$steps" ${from:+--start "$work/$from.pt" --seed 2} "$@"
    wait $!
}
# ship MODEL STEPS STEPS: in two courses, then a short one with the rounding of int8
ship() {
    pair "$1-first" "$1" "$2"
    pair "$1-second" "$1" "$3" "$1-first" --rate 1e-3
    pair "$1" "$1" 400 "$1-second" --rate 2e-4 --bytes
    "$python" scripts/train/ship.py "$work/data" "$work/$1.pt" "models/$1" --twin "$work/$1-twin.pt" \
        --golden tests/golden/fusion/shipped --date "$(date -u +%F)"
}
ship preview 2500 5000
ship default 6000 6000
