#!/bin/sh
# Installs what tests/slurm needs on Debian or Ubuntu (as root): Slurm's daemons and commands, and munge. No daemon is started; the tests
# start their own in a temporary folder, on free ports, and stop them.
set -eu
apt-get install -y --no-install-recommends slurm-wlm slurm-wlm-basic-plugins munge
