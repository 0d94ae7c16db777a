#!/usr/bin/env bash
# Does my controller still track as well as it did? Exit code 1 when it got worse.
#
#   ./tracking.sh                            run, and compare with the baselines in tracking/
#   ./tracking.sh --update "why"             make today's scores the baselines; commit them
set -euo pipefail
cd "$(dirname "$0")"

controller=my_cascade                # the YAML in configs/controller/ without its ending
package=my_lab                       # the package of its class: only classes named here may run
references=(square sine)
duration=40                          # s
rig=(plant.prior_seed=1 seed=1)      # a rig that is not quite the model; the same one every time

reason=
if [ "${1:-}" = --update ]; then
  reason="${2:?say why: ./tracking.sh --update \"why\"}"
fi
mkdir -p tracking
worse=0
for reference in "${references[@]}"; do
  if [ -z "$reason" ] && [ ! -f "tracking/$reference.json" ]; then
    echo "there is no baseline tracking/$reference.json yet: ./tracking.sh --update \"why\"" >&2
    exit 2
  fi
  rm -rf "tracking/runs/$reference"
  trms run --config-dir configs --allow "$package" "controller=$controller" "ref=$reference" \
    "sim.duration=$duration" "${rig[@]}" "out=tracking/runs/$reference"
  if [ -n "$reason" ]; then
    trms score "tracking/runs/$reference" --force --reason "$reason" \
      --write-baseline "tracking/$reference.json"
  else
    trms score "tracking/runs/$reference" --baseline "tracking/$reference.json" || worse=1
  fi
done
exit $worse
