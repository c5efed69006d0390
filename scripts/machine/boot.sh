# shellcheck shell=bash
# Root file system, disk and boot of the machine, for scripts/machine.sh to source.

# Makes Debian's root file system, once, and unpacks it with our package installed.
make_root() {
    local mirror
    if [ ! -e "$kept/root.tar" ]; then
        mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' | grep -m1 '/debian/*$') || unable "apt names no mirror"
        mmdebstrap --architectures="$arch" --variant=minbase \
            --include="systemd-sysv,udev,linux-image-$arch,dbus,iproute2,curl" trixie "$kept/new.tar" \
            "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] $mirror trixie main" >"$kept/root.log" 2>&1 ||
            unable "no root file system (see $kept/root.log)"
        mv "$kept/new.tar" "$kept/root.tar"
    fi
    [ -n "$deb" ] || deb=$(scripts/deb.sh "$arch" | head -1) || unable "no package"
    [ -e "$deb" ] || unable "no package"
    root=$work/root
    mkdir "$root" && tar -C "$root" -xf "$kept/root.tar"
    cp "$deb" "$root/root/stokescope.deb"
    chroot "$root" dpkg -i /root/stokescope.deb >"$work/dpkg.log" 2>&1 || unable "the package cannot be installed (see $kept/logs/dpkg.log)"
}

# Adds the checks and the configuration of the machine, and makes its disk.
make_disk() {
    install -m 755 scripts/machine/overlay.sh "$root/root/overlay"
    install -m 755 scripts/machine/checks.sh "$root/root/checks"
    cp scripts/machine/checks.service "$root/etc/systemd/system/"
    cp scripts/machine/*.toml "$root/etc/stokescope/"
    printf '[Match]\nName=en* eth*\n[Network]\nAddress=10.0.2.15/24\nGateway=10.0.2.2\n' >"$root/etc/systemd/network/80-lan.network"
    printf 'machine\n' >"$root/etc/hostname"
    sed -i 's/^root:[^:]*:/root::/' "$root/etc/shadow"
    chroot "$root" systemctl enable systemd-networkd stokescope checks >>"$work/dpkg.log" 2>&1
    cat >"$root/etc/stokescope/environment" <<'TEXT'
STOKESCOPE_BOARD=/etc/stokescope/board.toml
STOKESCOPE_OPTIONS=--listen 0.0.0.0:8080 --record /var/lib/stokescope/sessions --record-max-frames 60 --record-reserve-bytes 0
STOKESCOPE_TOKEN=machine-token
TEXT
    # an emulated machine is slow
    mkdir "$root/etc/systemd/system/stokescope.service.d"
    printf '[Service]\nTimeoutStartSec=600\n' >"$root/etc/systemd/system/stokescope.service.d/emulated.conf"
    truncate -s 2G "$work/disk.raw"
    mkfs.ext4 -q -d "$root" "$work/disk.raw"
    qemu-img convert -O qcow2 "$work/disk.raw" "$work/fresh.qcow2"
    cp "$work/fresh.qcow2" "$work/disk.qcow2"
    rm "$work/disk.raw"
    port=$((20000 + RANDOM % 20000))
}

# boot DISK LOG WORDS [readonly] [OPTION…]: starts the machine in the background; $machine is its process. WORDS are for its kernel.
boot() {
    local disk=$1 log=$2 words=$3 access= journal="systemd.journald.forward_to_console=1 systemd.journald.max_level_console=info"
    shift 3
    [ "${1:-}" != readonly ] || { access=,readonly=on && shift; }
    : >"$log"
    "${qemu[@]}" -smp 2 -m 768 -kernel "$root"/boot/vmlinuz-* -initrd "$root"/boot/initrd.img-* -nographic -no-reboot \
        -monitor "unix:$work/monitor,server,nowait" \
        -append "root=/dev/vda rw console=$console quiet systemd.show_status=0 $journal panic=-1 no_timer_check $words" \
        -drive "file=$disk,if=virtio,format=qcow2,cache=writeback$access" \
        -netdev "user,id=lan,hostfwd=tcp:127.0.0.1:$port-:8080" -device virtio-net-pci,netdev=lan,romfile= "$@" </dev/null >"$log" 2>&1 &
    machine=$!
}

# Cuts the power of the machine, where it still runs.
leave() {
    kill -9 "$machine" 2>/dev/null || true
    wait "$machine" 2>/dev/null || true
}

# until_said SECONDS LOG TEXT: waits until the machine says it on its console
until_said() {
    local end=$((SECONDS + $1))
    until grep -aq "$3" "$2"; do
        [ $SECONDS -lt $end ] && kill -0 "$machine" 2>/dev/null || return 1
        sleep 0.2
    done
}
