#!/bin/bash
# Makes the segmenter that ships: renders pictures on all cores, trains on a GPU, exports. Training judges by scenes it has not seen.
#   OUT=<folder> [CORES=16 RENDER_S=200 TRAIN_S=250 GPU=0 START=<network to go on from> SEED=<of the scenes> WIDTHS=<of the network>
#     FRAMES=<folder> NEGATIVES=<folder>] bash benchmarks/perception/segmenter.sh
# FRAMES is kept: what lies there from before is learned from too (RENDER_S=0: that alone), and while the network learns the cores go
# on rendering into it for the next call, by another SEED. Without it pictures lie in $TMPDIR meanwhile, some 0.2 MB each.
# Leaves in $OUT: segmenter.{safetensors,onnx} (for perception/weights), training.json, log.
# NEGATIVES holds pictures without a block: they are learned from.
# To try it: CORES=1 RENDER_S=90 TRAIN_S=40 SMALL=1 GPU= .
set -u
CORES=${CORES:-$(nproc)} RENDER_S=${RENDER_S:-600} TRAIN_S=${TRAIN_S:-600} GPU=${GPU-0} SMALL=${SMALL:-}
START=${START:-null} SEED=${SEED:-1000} WIDTHS=${WIDTHS:-24,36,56,88,112,112} FRAMES=${FRAMES:-} NEGATIVES=${NEGATIVES:-}
[ -n "$NEGATIVES" ] && NEGATIVES=$(realpath "$NEGATIVES")
# telling a graphics card what to do with 48 samples took longer than doing it
BATCH=192 RATE=0.003; [ "$START" != null ] && RATE=0.0015  # what was learned is not to be shaken out
mkdir -p "$OUT"
work=$(mktemp -d "${TMPDIR:-/tmp}/segmenter.XXXX"); mkdir -p "${FRAMES:-$work}"
frames=$(realpath "${FRAMES:-$work}")
begun=$(date +%s); say() { echo "[$(( $(date +%s) - begun )) s] $*" | tee -a "$work/log"; }
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
# Pictures to learn from are as large as views are kept, 480 x 270, a seventh of a second each: scenes are what there are too few
# of (of 450 frames a network knows the mouths by heart, of 2000 it does not yet), not pixels. A wide lens shows what the first look
# at a whole picture sees; longer ones, from farther away, are as sharp as the second look at a block is, which is where a disc differs
# from a hole.
small="rig.width=480 rig.height=270"
wide="$small rig.focal_px=264.0"
middle="$small rig.focal_px=528.0 scene.sight.distance_m=[1.0,3.0]"
long="$small rig.focal_px=1056.0 scene.sight.distance_m=[2.0,4.5]"
bare="$wide scene.block.present=0.0 scene.around.clutter=[2,14]"
full="rig.width=1280 rig.height=720 rig.focal_px=704.0"; [ -n "$SMALL" ] && full=$wide
drawn=(varied:wide varied:long hidden:wide empty:long varied:middle decoy:middle varied:wide varied:long empty:wide clean:wide
       varied:middle decoy:long varied:bare empty:middle varied:wide hidden:middle varied:long empty:long haze:wide varied:middle
       varied:bare)

# One process a core. Of each eight (four, if there are few) one draws scenes to judge by, a condition at a time, unless there are
# some from before; the others draw varied scenes and, half of the time, the conditions of the table, by other seeds; each begins
# elsewhere in the list, since none may come to its end.
each=8; (( CORES < 16 )) && each=4
judged=; [ -d "$frames/test" ] && judged=there
render() {  # scene, size, seed, folder, first, count, until
  local left=$(( $7 - $(date +%s) )); (( left > 3 )) || return
  timeout -k 5 -s INT $left brokk mode=render scene="$1" rig=zed_2i_1080p $2 session.seed="$3" session.out="$frames/$4" \
    render.first="$5" render.count="$6" studio.depth=none studio.pair=false >>"$work/render.log" 2>&1
}
draw() {  # number of the process, until when
  local k=$1 until=$2 round=0 scene lens
  if [ -z "$judged" ] && (( k % each == each - 1 || CORES < each && k == 0 )); then
    for scene in clean varied hidden decoy haze dark empty; do
      render $scene "$full" 900 test/$scene/$k $(( k * 100 )) $(( CORES < each ? 2 : 8 )) $until
    done
  fi
  while (( until - $(date +%s) > 6 )); do
    IFS=: read -r scene lens <<<"${drawn[(4 * k + round) % ${#drawn[@]}]}"
    render $scene "${!lens}" $(( SEED + k )) train/$SEED.$k/$round $(( round * 100 )) 100 $until
    round=$(( round + 1 ))
  done
}
until=$(( begun + RENDER_S )); [ -n "$FRAMES" ] && until=$(( until + TRAIN_S ))
say "renders on $CORES cores for $RENDER_S s$([ -n "$FRAMES" ] && echo ", and while it trains, into $FRAMES")"
for (( k = 0; k < CORES; k++ )); do draw "$k" $until & done
if [ -n "$FRAMES" ]; then sleep "$RENDER_S"; else wait; fi
count() { find "$frames/$1" -name '*.mask.png' 2>/dev/null | wc -l; }
say "$(count train) frames to train on, $(count test) to judge by; $(du -sh "$frames" | cut -f1)"

# the scenes to judge by also choose the best of about eight updates, which flatters them little
folders=$(find "$frames/test" -name '*.mask.png' -printf '%h\n' | sort -u | paste -sd,)
device=cuda; [ -z "$GPU" ] && device=cpu; export CUDA_VISIBLE_DEVICES=$GPU
few=("training.widths=[$WIDTHS]" training.batch=$BATCH)
[ -n "$SMALL" ] && few=("training.size_px=[160,96]" training.batch=8)
say "trains for $TRAIN_S s on $device from $START"
timeout -s INT -k 60 $(( TRAIN_S + 180 )) brokk mode=train_perception training.frames="$frames/train" "training.validation=[$folders]" \
  ${NEGATIVES:+training.negatives="$NEGATIVES"} training.updates=1000000 training.start="$START" training.max_seconds="$TRAIN_S" training.rate=$RATE \
  training.validate_every=$([ -n "$SMALL" ] && echo 20 || echo 1200) session.device=$device session.out="$work/run" "${few[@]}" 2>&1 | tee -a "$work/log"
say "trained, $(count train) frames there now: $(ls "$work/run" | tr '\n' ' ')"

keep() {  # whatever is there by now: judging may be cut off
  local file
  for file in segmenter.safetensors segmenter.onnx training.json; do
    [ -f "$work/run/$file" ] && cp "$work/run/$file" "$OUT/"
  done
  cp "$work/log" "$OUT/log"
}
keep
wait  # for those that still render
tail -5 "$work/render.log" >>"$work/log"; say "done: $OUT"; keep
rm -rf "$work"
