#!/bin/sh
# Makes the sample recordings of this folder again: sh bags/synthesize.sh
set -eu
cd "$(dirname "$0")"

railtrack synthesize --track mainline_soft_pads --vehicle two_wheels.yaml \
    --duration 3 --speed 25 --sample-rate 12800 --roughness iso3095 \
    --corrugation 0.045:20e-6:30:50 --seed 1 corrugated_two_wheels.mcap

railtrack synthesize --track mainline_soft_pads --vehicle one_wheelset.yaml \
    --duration 3 --speed 25 --acceleration -3 --start-position 1000 --sample-rate 12800 \
    --roughness iso3095 --corrugation 0.06:15e-6:1030:1045:right --seed 2 braking_wheelset.mcap
