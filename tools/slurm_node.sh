#!/bin/sh
# A Slurm cluster of this one machine, for trying and testing `engine: slurm`: no systemd, nothing
# outside one folder, no ports or sockets of a Slurm that may already be here.
#
#   tools/slurm_node.sh start FOLDER [LICENCES]    e.g. nastran:2; then: export SLURM_CONF=FOLDER/slurm.conf
#   tools/slurm_node.sh stop FOLDER
#
# Needs Debian's slurm-wlm and munge (apt-get install --no-install-recommends slurm-wlm munge).
# Everything runs as the user who starts it and ends with `stop`.
set -eu

fail() {
    echo "slurm_node: $1" >&2
    exit 1
}

stop() {
    for name in slurmctld slurmd munged; do
        if [ -s "$1/$name.pid" ]; then
            kill "$(cat "$1/$name.pid")" 2>/dev/null || true
            rm -f "$1/$name.pid"
        fi
    done
}

free_port() {
    python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])'
}

configure() {
    host=$(hostname -s)
    cat >"$1/slurm.conf" <<CONF
ClusterName=modetune
SlurmctldHost=$host(127.0.0.1)
SlurmctldPort=$(free_port)
SlurmdPort=$(free_port)
SlurmUser=$(id -un)
SlurmdUser=$(id -un)
AuthType=auth/munge
AuthInfo=socket=$1/munge.socket
CredType=cred/munge
MpiDefault=none
# Without systemd there are no control groups to keep jobs in.
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=sched_min_interval=100000,batch_sched_delay=0
KillWait=2
ReturnToService=2
Licenses=$2
StateSaveLocation=$1/state
SlurmdSpoolDir=$1/spool
SlurmctldPidFile=$1/slurmctld.pid
SlurmdPidFile=$1/slurmd.pid
SlurmctldLogFile=$1/slurmctld.log
SlurmdLogFile=$1/slurmd.log
NodeName=$host NodeAddr=127.0.0.1 CPUs=$(nproc) RealMemory=$(free -m | awk '/^Mem/ {print $2}') State=UNKNOWN
PartitionName=batch Nodes=$host Default=YES MaxTime=INFINITE State=UP
CONF
}

start() {
    for program in munged slurmctld slurmd srun; do
        PATH="$PATH:/usr/sbin" command -v "$program" >/dev/null || fail "$program is not installed"
    done
    PATH="$PATH:/usr/sbin"
    mkdir -p "$1/state" "$1/spool"
    chmod 755 "$1"
    head -c 128 /dev/urandom >"$1/munge.key"
    chmod 600 "$1/munge.key"
    configure "$1" "$2"
    export SLURM_CONF="$1/slurm.conf"
    # --force: munged does not like a socket outside /run
    munged --force --socket="$1/munge.socket" --key-file="$1/munge.key" \
        --pid-file="$1/munged.pid" --log-file="$1/munged.log" --seed-file="$1/munged.seed" \
        2>/dev/null || fail "munged does not start: see $1/munged.log"
    slurmctld -c || fail "slurmctld does not start: see $1/slurmctld.log"
    slurmd || fail "slurmd does not start: see $1/slurmd.log"
    tries=0
    until sinfo -h -o %T 2>/dev/null | grep -q idle; do
        tries=$((tries + 1))
        [ "$tries" -lt 100 ] || fail "the node does not come up: see the logs in $1"
        sleep 0.2
    done
}

[ $# -ge 2 ] || fail "start FOLDER [LICENCES] or stop FOLDER"
mkdir -p "$2"
folder=$(cd "$2" && pwd)
case "$1" in
start) start "$folder" "${3:-nastran:2}" ;;
stop) stop "$folder" ;;
*) fail "start FOLDER [LICENCES] or stop FOLDER" ;;
esac
