#!/bin/sh
# slurm.sh: a real Slurm on this machine starts render servers with wall-config/render-servers.sbatch, and a wall shows
# frames that they rendered. Needs root; installs Debian's Slurm.
set -eu
cd "$(dirname "$0")/.."

fail() { echo "test-slurm: $*" >&2; exit 1; }
[ "$(id -u)" = 0 ] || fail "run this as root: Slurm's daemons start jobs for other users"
if ! command -v slurmctld >/dev/null || ! command -v slurmd >/dev/null || ! command -v srun >/dev/null; then
    command -v apt-get >/dev/null || fail "install Slurm's slurmctld, slurmd and srun, and munge, then run this again"
    DEBIAN_FRONTEND=noninteractive apt-get update -q >/dev/null
    DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends slurmctld slurmd slurm-client munge >/dev/null
fi

dir=$(mktemp -d)
daemons=
munge_is_ours=
clean() {
    status=$?
    [ $status = 0 ] || tail -n 20 "$dir"/*.log 2>/dev/null || true
    scancel --user=root --jobname=raywall 2>/dev/null || true
    for pid in $daemons; do kill "$pid" 2>/dev/null || true; done
    for pid in $daemons; do wait "$pid" 2>/dev/null || true; done
    [ -z "$munge_is_ours" ] || runuser -u munge -- munged --stop 2>/dev/null || true
    rm -rf "$dir"
    exit $status
}
trap clean EXIT
trap 'exit 1' INT TERM
# wait_for SECONDS COMMAND...: repeats the command until it succeeds.
wait_for() {
    left=$(($1 * 5)); shift
    until "$@" >/dev/null 2>&1; do
        left=$((left - 1))
        [ $left -gt 0 ] || return 1
        sleep 0.2
    done
}

if ! munge -n >/dev/null 2>&1; then
    mkdir -p /run/munge && chown munge: /run/munge
    runuser -u munge -- munged
    munge_is_ours=1
fi
export SLURM_CONF="$dir/slurm.conf"
cores=$(nproc)
[ "$cores" -ge 2 ] || fail "Slurm gives each task a core, but this machine has only one"
sed -e "s|HOST|$(hostname -s)|; s|DIR|$dir|; s|CORES|$cores|" tests/slurm.conf >"$SLURM_CONF"
mkdir "$dir/ctld" "$dir/d"
slurmctld -D >/dev/null 2>&1 & daemons="$daemons $!"
slurmd -D >/dev/null 2>&1 & daemons="$daemons $!"
wait_for 30 srun --immediate=2 -n2 true || fail "Slurm does not start"

frames() {
    # frames NUMBER: runs a wall with at least two render servers until it has NUMBER whole frames.
    target/release/compositor --headless --listen 127.0.0.1:0 --local 0 --min-renderers 2 \
        --triangles 20000 --size 256x128 --frames "$1" --stats "$dir/stats.json" >"$dir/wall.log" 2>&1
}
frames 20 & wall=$!
daemons="$daemons $wall"
wait_for 20 grep -q 'listening on ' "$dir/wall.log" || fail "the wall does not listen"
address=$(sed -n 's/.*listening on \([^ ]*\).*/\1/p' "$dir/wall.log" | head -n 1)
job=$(RAYWALL_RENDERER=$PWD/target/release/renderer sbatch --parsable --nodes=1 --ntasks-per-node=2 --cpus-per-task=1 \
    --output="$dir/job.log" wall-config/render-servers.sbatch "$address")
wait $wall || fail "the wall shows no frames"
n_nodes=$(grep -c '"busy_ms"' "$dir/stats.json")
[ "$n_nodes" -ge 40 ] || fail "20 frames have $n_nodes parts: some are not from two render servers"

scancel "$job"
wait_for 20 sh -c "! squeue -h -j $job -t running,completing | grep -q ." || fail "the job does not end with scancel"
if pgrep -f "renderer connect $address" >/dev/null; then fail "render servers outlive their job"; fi
echo "test-slurm: 20 frames by two render servers started by Slurm; they ended with their job"
