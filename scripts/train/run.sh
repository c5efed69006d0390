#!/bin/sh
# Trains and ships both fusion models, from nothing: an hour and a half on two cores.
#
#   scripts/train/run.sh [WORK]      WORK: folder for data and checkpoints, default target/train; what is there already is kept
#
# $STOKESCOPE_SCENES: a folder of measured scenes (see Measured in scenes.py), ../shared/data where that exists. Without one the
# networks learn from procedural scenes alone and there is nothing to judge them by. Seeded: on one kind of processor data, weights,
# model files and golden answers come out the same to the last bit; on another, PyTorch sums in another order, and a course that differs
# in the last digit ends at other weights.
set -eu
cd "$(dirname "$0")/../.."
work=${1:-target/train}
scenes=${STOKESCOPE_SCENES:-../shared/data}
mkdir -p "$work"
[ -x "$work/venv/bin/python" ] || python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet -r scripts/train/requirements.txt
python=$work/venv/bin/python
export OMP_NUM_THREADS=1 OMP_WAIT_POLICY=passive OPENBLAS_NUM_THREADS=1
"$work/venv/bin/pip" install --quiet ./crates/python
set --
[ -d "$scenes" ] && set -- --scenes "$scenes"
"$python" scripts/train/captures.py "$work/data" "$@"

"$python" scripts/train/train.py "$work/data"

# train RUN SIZE FOLDS STEPS [OPTION ...]; what is there is kept
train() {
    run=$work/$1.pt size=$2 folds=$3 steps=$4
    shift 4
    [ -e "$run" ] || "$python" scripts/train/train.py "$work/data" "$run" --size "$size" --folds "$folds" --steps "$steps" "$@"
}
# A model learns from all measured scenes; its twin does without those of fold B, to be judged by them.
# pair RUN SIZE STEPS [OPTION ...]: both, side by side; with FROM set, each goes on from its part of that pair
pair() {
    run=$1 size=$2 steps=$3
    shift 3
    train "$run-twin" "$size" A "$steps" ${FROM:+--start "$work/$FROM-twin.pt" --seed 2} "$@" &
    train "$run" "$size" AB "$steps" ${FROM:+--start "$work/$FROM.pt" --seed 2} "$@"
    wait $!
}
# ship MODEL STEPS: a course, then a short one with the rounding of int8
ship() {
    FROM='' pair "$1-float" "$1" "$2"
    FROM=$1-float pair "$1" "$1" 400 --rate 2e-4 --bytes
    "$python" scripts/train/ship.py "$work/data" "$work/$1.pt" "models/$1" --twin "$work/$1-twin.pt" \
        --golden tests/golden/fusion/shipped --date "$(date -u +%F)"
}
ship default 5000
ship preview 3500
