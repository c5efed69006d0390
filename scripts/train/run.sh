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
# pair RUN SIZE STEPS [RUN]: both, side by side, from nothing, or going on from another pair with the rounding of int8
pair() {
    train "$1-twin" "$2" A "$3" ${4:+--start "$work/$4-twin.pt" --bytes --rate 2e-4 --seed 2} &
    train "$1" "$2" AB "$3" ${4:+--start "$work/$4.pt" --bytes --rate 2e-4 --seed 2}
    wait $!
}
ship() {
    pair "$1-float" "$1" 6000
    pair "$1" "$1" 400 "$1-float"
    "$python" scripts/train/ship.py "$work/data" "$work/$1.pt" "models/$1" --twin "$work/$1-twin.pt" \
        --golden tests/golden/fusion/shipped --date "$(date -u +%F)"
}
ship preview
ship default
