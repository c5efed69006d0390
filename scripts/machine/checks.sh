#!/bin/sh
# Checks of the service from inside the machine, one line each on the console; see scripts/machine.sh. The kernel's command line names the
# part: main[,short], overlay, or what is to be interrupted by a power cut.
unit=stokescope
sessions=/var/lib/stokescope/sessions
said() { printf '\nCHECK %s %s\n' "$1" "$2"; }
check() { if eval "$2"; then said ok "$1"; else said no "$1" && journalctl -u $unit --no-pager -n 12; fi; }
# wait_for SECONDS COMMAND: an emulated machine beside other work may take three times as long
wait_for() {
    end=$(($(cut -d. -f1 /proc/uptime) + 3 * $1))
    until eval "$2"; do
        [ "$(cut -d. -f1 /proc/uptime)" -lt $end ] || return 1
        sleep 1
    done
}
value() { systemctl show $unit -p "$1" --value; }
active() { [ "$(value ActiveState)/$(value SubState)" = active/running ]; }
serving() { active && curl -s -H 'Authorization: Bearer machine-token' --max-time 10 "http://${1:-127.0.0.1}:8080/healthz" | grep -q ok; }
recorded() { find $sessions -name '*.json' -path '*/frames/*' | wc -l; }
# with KEY=VALUE…: restarts the unit with settings of its own
with() {
    mkdir -p /etc/systemd/system/$unit.service.d
    { echo '[Service]'; for line; do echo "$line"; done; } >/etc/systemd/system/$unit.service.d/checks.conf
    systemctl daemon-reload
    systemctl restart --no-block $unit
}
limit() { cat "/sys/fs/cgroup$(value ControlGroup)/$1"; }

watchdog_and_failures() {
    check 'the watchdog is fed' 'n=$(value WatchdogTimestampMonotonic); sleep 5; [ "$(value WatchdogTimestampMonotonic)" -gt "$n" ]'
    with WatchdogSec=15 RestartSec=1
    wait_for 120 serving
    kill -STOP "$(value MainPID)"
    check 'the watchdog restarts a service that hangs' 'wait_for 180 "[ \$(value NRestarts) -ge 1 ] && serving"'
    with RestartSec=100ms RestartSteps=0 ExecStart= ExecStart=/bin/false
    check 'twenty failures do not stop it for good' 'wait_for 180 "[ \$(value NRestarts) -ge 20 ]" && ! systemctl is-failed -q $unit'
}

limits() {
    with MemoryMax=160M CPUQuota=150%
    check 'it runs within the limits of a small board' 'wait_for 180 serving && [ "$(limit memory.max)" = 167772160 ] && sleep 10 && serving'
    check 'no process was killed for memory' 'grep -q "oom_kill 0" "/sys/fs/cgroup$(value ControlGroup)/memory.events"'
}

# A bundle for vivid.toml, then a service that begins before its cameras are there.
late_cameras() {
    bundle=/etc/stokescope/bundle
    stokescope simulate --out $bundle --size 64x64 --color rgb --guide-margin 0 >/dev/null
    sed -i 's/^bit_depth = .*/bit_depth = 10/; s/^black_level = .*/black_level = 0/; s/^saturation = .*/saturation = 1023/
        s/^width = .*/width = 320/; s/^height = .*/height = 180\ncrop = [96, 26, 128, 128]\nbin = 2/; /^\[guide\]/,/^$/d' $bundle/calibration.toml
    printf '\n[guide]\nhomography = [0.5, 0, 0, 0, 0.5, 0, 0, 0, 1]\n' >>$bundle/calibration.toml
    echo STOKESCOPE_BOARD=/etc/stokescope/vivid.toml >/etc/stokescope/vivid
    with EnvironmentFile=/etc/stokescope/vivid RestartSec=2 RestartSteps=0
    sleep 20
    check 'a service without its cameras goes on trying' '! serving && ! systemctl is-failed -q $unit'
    modprobe vivid n_devs=2 node_types=0x1,0x1 num_inputs=1,1 input_types=0,0
    check 'two cameras that come late are used' 'wait_for 300 serving'
    check 'their frames are cropped and binned' 'tr -d " \n" </run/stokescope/report.json | grep -q "\"size\":\[64,64\]"'
}

package() {
    rm -f /etc/systemd/system/$unit.service.d/checks.conf
    systemctl daemon-reload
    echo '# kept' >>/etc/stokescope/environment
    before=$(value MainPID)
    check 'an upgrade installs' 'dpkg -i /root/stokescope.deb >/dev/null 2>&1'
    check 'an upgrade keeps the configuration' 'grep -q "# kept" /etc/stokescope/environment'
    check 'an upgrade restarts the service' 'wait_for 180 serving && [ "$(value MainPID)" != "$before" ]'
    systemctl stop $unit
    before=$(recorded)
    check 'removal works' 'dpkg -r stokescope >/dev/null 2>&1 && ! [ -e /usr/bin/stokescope ]'
    check 'removal leaves the recordings' '[ "$before" -ge 1 ] && [ "$(recorded)" = "$before" ]'
}

first() {
    wait_for 300 serving
    echo 'MACHINE serving'
    check 'the service runs under systemd' serving
    check 'frames are recorded' 'wait_for 120 "[ \$(recorded) -ge 20 ]"'
    check 'the log is in the journal' 'journalctl -u $unit --no-pager | grep -q "preview: http://"'
    # the machine outside has time to ask
    sleep 25
    watchdog_and_failures
    limits
    case $part in *short*) ;; *) late_cameras ;; esac
    package
}

overlay() {
    check 'the root is read-only below a file system in memory' 'grep -q "^overlay / overlay" /proc/mounts && [ "$(cat /sys/block/vda/ro)" = 1 ]'
    check 'it runs without a network' 'wait_for 300 serving && [ -z "$(ip -o addr show scope global)" ]'
    check 'it records to what is writable' 'wait_for 120 "[ \$(recorded) -ge 5 ]"'
    echo 'STOKESCOPE_OPTIONS=--listen 10.0.2.15:8080' >/etc/stokescope/late
    with EnvironmentFile=/etc/stokescope/late RestartSec=2 RestartSteps=0
    check 'an address that is not there is tried again and again' 'wait_for 120 "[ \$(value NRestarts) -ge 3 ]"'
    link=$(basename /sys/class/net/e*)
    ip link set "$link" up && ip addr add 10.0.2.15/24 dev "$link"
    check 'the address is served when it is there' 'wait_for 180 "serving 10.0.2.15"'
    echo 'MACHINE address'
    sleep 30
}

# Work that a power cut interrupts.
upgrades() { while :; do dpkg -i /root/stokescope.deb; done; }
calibrations() {
    cd /var/lib/stokescope && mkdir -p calibrated && cd calibrated || exit
    stokescope simulate --out bundle --size 48 >/dev/null
    for n in 1 2 3; do stokescope simulate --out "dark$n" --scene dark --size 48 --noise 0.003 --seed $n >/dev/null; done
    dark() { stokescope calibrate dark --bundle bundle --from "dark$1/raw.npy" "dark$2/raw.npy" --out picture.png; }
    dark 1 2 && cp bundle/calibration.toml one.toml && dark 2 3 && cp bundle/calibration.toml other.toml && sync
    while :; do dark 1 2 && dark 2 3; done
}

interrupted() {
    [ "$part" != again ] || dpkg --configure -a
    wait_for 400 serving
    begin=$(date +%s)
    # recording is to remove the oldest frames, too, when the power is cut
    case $part in record | past) most=55 ;; *) most=10 ;; esac
    # frames of now, where the clock has been set back, too
    new="find $sessions -name '*.json' -path '*/frames/*' -newermt @$begin ! -newermt @$((begin + 86400))"
    wait_for 300 "[ \$($new | wc -l) -ge 10 ] && [ \$(recorded) -ge $most ]" || exit
    case $part in
        upgrade) upgrades & ;;
        calibrate) calibrations & ;;
    esac >/dev/null 2>&1
    [ "$part" != calibrate ] || wait_for 300 '[ -e /var/lib/stokescope/calibrated/other.toml ]'
    echo 'MACHINE busy'
    sleep infinity
}

part=$(sed -n 's/.*stokescope\.checks=\([a-z,]*\).*/\1/p' /proc/cmdline)
case $part in
    main*) first ;;
    overlay) overlay ;;
    *) interrupted ;;
esac
echo 'MACHINE end'
systemctl poweroff
