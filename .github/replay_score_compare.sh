#!/usr/bin/env bash
# Replays $DRIVES, scores them, compares the scores with those in $AGAINST, and writes a summary in Markdown.
# Exit status: that of the first command that failed; losses (status 3) are reported and fail nothing.
set -uo pipefail
worst=0
mkdir -p "$OUTPUT"

try() {  # try COMMAND...: remembers the first status that is a failure
  "$@"
  local status=$?
  if [[ $status != 0 && $status != 3 && $worst == 0 ]]; then worst=$status; fi
  return $status
}

read -r -a tolerances <<<"${TOLERANCE:-}"
try crosscue replay "$DRIVES" -o "$OUTPUT/runs" ${VEHICLE:+--vehicle "$VEHICLE"} ${DETECTORS:+--detectors "$DETECTORS"}
if [[ $worst == 0 ]]; then
  try crosscue score "$OUTPUT/runs" -o "$OUTPUT/scored" ${TRUTH:+--truth "$TRUTH"} ${GATE:+--gate "$GATE"} >"$OUTPUT/score.txt"
  cat "$OUTPUT/score.txt"
  {
    echo "### crosscue"
    echo '```'
    cat "$OUTPUT/score.txt"
    echo '```'
  } >"$OUTPUT/summary.md"
  if [[ -n "${AGAINST:-}" ]]; then
    try crosscue compare "$AGAINST/scored" "$OUTPUT/scored" --markdown \
      ${tolerances[@]:+--tolerance "${tolerances[@]}"} >>"$OUTPUT/summary.md"
  fi
else
  echo "crosscue: the replay failed with exit status $worst" >"$OUTPUT/summary.md"
fi
cat "$OUTPUT/summary.md" >>"${GITHUB_STEP_SUMMARY:-/dev/null}"
exit $worst
