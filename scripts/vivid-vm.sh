#!/usr/bin/env bash
# Captures through the real Video4Linux, without hardware: boots a small virtual machine (x86-64, emulated) with Debian's
# kernel and two instances of its test driver vivid, and there runs the tests of the backend and `stokescope run` with
# two 10-bit Bayer cameras, with errors and a disconnection injected. Run as root it installs what it needs.
#
# STOKESCOPE_VIVID_CACHE: folder of the kernel [default: target/vivid-vm]. STOKESCOPE, STOKESCOPE_TESTS: see scripts/lib/build.sh.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib/build.sh
. scripts/lib/debian.sh
work=${STOKESCOPE_VIVID_CACHE:-$PWD/target/vivid-vm}
mkdir -p "$work"

say() { printf '== %s\n' "$*"; }
fail() { printf 'FAIL %s\n' "$*" >&2; exit 1; }

packages="qemu-system-x86 busybox-static cpio kmod xz-utils v4l-utils libclang-dev dpkg-dev"
# shellcheck disable=SC2086
debian_need "$work/install.log" $packages || fail "packages"

if ! ls "$work"/kernel/boot/vmlinuz-* >/dev/null 2>&1; then
    say "Debian's kernel"
    mkdir -p "$work/kernel"
    debian_suite "$work/apt" deb trixie arch=amd64 || fail "package list"
    suite+=(-o APT::Architecture=amd64)
    package=$(apt-cache "${suite[@]}" depends linux-image-amd64 | grep -oE 'linux-image-[0-9][^ ]*' | head -1)
    (cd "$work" && rm -f linux-image-*.deb && apt-get "${suite[@]}" download "$package" >>"$work/kernel.log" 2>&1 &&
        dpkg -x linux-image-*.deb kernel && rm linux-image-*.deb) || fail "kernel; see $work/kernel.log"
fi
vmlinuz=$(ls "$work"/kernel/boot/vmlinuz-* | head -1)
version=${vmlinuz##*/vmlinuz-}
say "kernel $version"

say "build"
build_with v4l2 "$work/tests.log" || fail "build"

say "a disk in memory"
root=$work/root
rm -rf "$root"
mkdir -p "$root"/{bin,dev,proc,sys,tmp,modules,board}
cp /bin/busybox "$root/bin/busybox"
# a program and the libraries it names
take() {
    cp -L "$1" "$root/bin/${2:-$(basename "$1")}"
    strip "$root/bin/${2:-$(basename "$1")}" 2>/dev/null || true
    ldd "$1" | grep -oE '/[^ ]+' | while read -r library; do
        case $library in
            */ld-linux*) to=$root$library ;;
            *) to=$root/lib/$(basename "$library") ;;
        esac
        mkdir -p "$(dirname "$to")"
        cp -Ln "$library" "$to"
    done
}
take "$bin" stokescope
take "$tests" tests
take "$(command -v v4l2-ctl)"
depmod -b "$work/kernel/usr" "$version" 2>/dev/null || depmod -b "$work/kernel" "$version"
modules=$(dirname "$(find "$work/kernel" -name modules.dep | head -1)")
line=$(grep '/vivid\.ko[.a-z]*:' "$modules/modules.dep")
# what a module needs stands after it, the last first
order=$(printf '%s\n' $line | tac | tr -d ':')
n=0
for module in $order; do
    n=$((n + 1))
    to=$root/modules/$(printf '%02d' $n)-$(basename "$module" .xz)
    case $module in
        *.xz) xz -dc "$modules/$module" >"$to" ;;
        *) cp "$modules/$module" "$to" ;;
    esac
done
# a bundle of NAME and SIZE for the driver's frames; they end at their border, and to plan for more takes an emulated machine minutes
bundle() {
    "$bin" simulate --out "$root/board/$1" --size "$2" --color rgb --guide-margin 0 >/dev/null
    sed -i 's/^bit_depth = .*/bit_depth = 10/; s/^black_level = .*/black_level = 0/; s/^saturation = .*/saturation = 1023/' \
        "$root/board/$1/calibration.toml"
    printf '[field]\nmargin = 0\n' >>"$root/board/$1/calibration.toml"
}
bundle bundle 160x90
# few frames a second: an emulated processor takes long to draw and to unpack each of them
camera() {
    printf '[cameras.%s]\nbackend = "v4l2"\nsource = "/dev/video%s"\nwidth = 320\nheight = 180\nformat = "bggr10"\n' "$1" "$2"
    printf 'frame_rate = 2.0\ngain = 100.0\n'
}
board() {
    printf 'inherit = "x86-sim"\ndescription = "two vivid cameras"\n[memory]\nlimit_bytes = 268435456\n[solver]\n'
    printf 'iterations = 1\nregister = false\n[cameras]\ncalibration = "bundle"\nmax_skew_us = 250000\n'
    camera raw 0
    camera guide 1
}
board >"$root/board/vivid.toml"
# the guide as a USB camera: no format is asked for, colour is what suits it
board | awk '/^\[cameras.guide\]/ { guide = 1 } !(guide && /^format/)' | sed 's/"bundle"/"usb"/' >"$root/board/usb.toml"
cp -r "$root/board/bundle" "$root/board/usb"
printf '[guide]\nhomography = [2, 0, 0.5, 0, 2, 0.5, 0, 0, 1]\n' >>"$root/board/usb/calibration.toml"

# real modes, of whose planes (half as large) a part is used: 256 × 256 of it as they are, or blocks of 2 × 2
cropped() {
    local name=$1 width=$2 height=$3 crop=$4 blocks=$5
    bundle "$name" 256x256
    sed -i "s/^width = .*/width = $((width / 2))/; s/^height = .*/height = $((height / 2))\ncrop = [$crop]\nbin = $blocks/" \
        "$root/board/$name/calibration.toml"
    board | awk '/^\[cameras.guide\]/ { exit } 1' | sed "s/\"bundle\"/\"$name\"/; s/^width = .*/width = $width/; s/^height = .*/height = $height/
        s/^frame_rate = .*/frame_rate = 1.0/; s/^\[cameras\]/[cameras]\nguided = false/" >"$root/board/$name.toml"
}
cropped hd 1280 720 "192, 52, 256, 256" 1
cropped full-hd 1920 1080 "224, 14, 512, 512" 2

cat >"$root/init" <<'INIT'
#!/bin/busybox sh
bb=/bin/busybox
$bb --install -s /bin
export PATH=/bin HOME=/tmp LD_LIBRARY_PATH=/lib RUST_BACKTRACE=1
mount -t proc none /proc; mount -t sysfs none /sys; mount -t devtmpfs none /dev; mount -t tmpfs none /tmp
ip link set lo up 2>/dev/null
end() { echo "VERDICT $1"; sync; poweroff -f; }
fail() { echo "FAIL $*"; end FAIL; }
for module in /modules/*.ko; do
    case $module in
        *vivid.ko) insmod "$module" n_devs=2 node_types=0x1,0x1 num_inputs=1,1 input_types=0,0 || fail "insmod $module" ;;
        *) insmod "$module" || fail "insmod $module" ;;
    esac
done
[ -e /dev/video1 ] || fail "no /dev/video1"

stokescope cameras --json >/tmp/cameras.json || fail "cameras"
for text in '"source":"/dev/video0"' '"source":"/dev/video1"' '"bggr10"' '"name":"v4l2"'; do
    grep -q "$text" /tmp/cameras.json || { cat /tmp/cameras.json; fail "cameras --json names no $text"; }
done
echo "PASS stokescope cameras --json lists both with 10-bit Bayer modes"

STOKESCOPE_VIVID=1 tests camera::v4l2 --test-threads 1 >/tmp/tests.log 2>&1 || { cat /tmp/tests.log; fail "tests of the backend"; }
grep -q SKIPPED /tmp/tests.log && fail "tests were skipped"
grep -E '^test .*vivid.*ok$' /tmp/tests.log | sed 's/^test camera::v4l2::tests::/PASS /; s/ \.\.\. ok$//'

stokescope doctor --board /board/vivid.toml --out /tmp/out >/tmp/doctor.log 2>&1
# the bars are flat at three quarters of full light, which is taken for clipping
grep -qE '(fine|warning) +raw camera +/dev/video0 .*BGGR 10-bit of 320×180' /tmp/doctor.log || { cat /tmp/doctor.log; fail "doctor"; }
echo "PASS doctor opens the cameras"

stokescope --json run --board /board/vivid.toml --fusion off --no-preview --frames 5 --out /tmp/out >/tmp/run.json 2>/tmp/run.log ||
    { cat /tmp/run.log; fail "run"; }
grep -q '"frames":5' /tmp/run.json || { cat /tmp/run.json; fail "not all frames"; }
[ -s /tmp/out/frame-000004/angles.npy ] || fail "frames are not saved"
v4l2-ctl -d /dev/video0 -C gain | grep -q 'gain: 100' || fail "the gain is not set: $(v4l2-ctl -d /dev/video0 -C gain)"
echo "PASS run: 5 pairs of 10-bit Bayer frames, saved, gain set: $(cat /tmp/run.json)"

stokescope --json run --board /board/usb.toml --fusion off --no-preview --frames 3 --out /tmp/out1 >/tmp/run.json 2>/tmp/run.log ||
    { cat /tmp/run.log; fail "run with a guide left to itself"; }
grep -q '"frames":3' /tmp/run.json || { cat /tmp/run.json; fail "not all frames with a guide left to itself"; }
stokescope capture --board /board/usb.toml --frames 1 --out /tmp/session >/dev/null 2>/tmp/run.log || { cat /tmp/run.log; fail "capture"; }
grep -q '"format": "\(yuyv\|nv12\|rgb8\)"' /tmp/session/session.json || { cat /tmp/session/session.json; fail "the guide gives no colour"; }
echo "PASS run with a guide left to itself, 3 pairs: $(grep -o '"format": "[^"]*"' /tmp/session/session.json | tr '\n' ' ')"

for mode in hd full-hd; do
    stokescope --json run --board /board/$mode.toml --fusion off --no-preview --frames 2 --out /tmp/$mode >/tmp/run.json 2>/tmp/run.log ||
        { cat /tmp/run.log; fail "run of $mode frames"; }
    grep -q '"frames":2' /tmp/run.json || { cat /tmp/run.json; fail "not all $mode frames"; }
    tr -d ' \n' </tmp/$mode/report.json | grep -q '"size":\[256,256\]' || { cat /tmp/$mode/report.json; fail "$mode frames are not 256×256"; }
    echo "PASS run: Bayer frames of $mode are cropped and binned to 256×256: $(cat /tmp/run.json)"
done

stokescope --json run --board /board/vivid.toml --fusion off --no-preview --frames 16 --out /tmp/out2 >/tmp/run.json 2>/tmp/run.log &
run=$!
for i in $(seq 600); do [ -e /tmp/out2/frame-000001 ] && break; sleep 0.5; done
for i in 1 2 3; do v4l2-ctl -d /dev/video0 -c inject_v4l2_buf_flag_error=1; sleep 0.3; done
v4l2-ctl -d /dev/video1 -c inject_fatal_streaming_error=1; sleep 3
v4l2-ctl -d /dev/video0 -c disconnect=1
wait $run || { cat /tmp/run.log; fail "run with injected errors: exit code $?"; }
grep -q '"frames":16' /tmp/run.json || { cat /tmp/run.json /tmp/run.log; fail "not all frames with injected errors"; }
grep -q 'raw camera offline: /dev/video0 .*lost: ' /tmp/run.log || { cat /tmp/run.log; fail "the disconnection is not said"; }
grep -q 'guide camera offline: /dev/video1 .*lost: ' /tmp/run.log || { cat /tmp/run.log; fail "the fatal error is not said"; }
[ "$(grep -c 'camera: frames again' /tmp/run.log)" = 2 ] || { cat /tmp/run.log; fail "the cameras do not come back"; }
echo "PASS run survives frame errors, a fatal error and a disconnection: $(cat /tmp/run.json)"
grep -E 'offline|again' /tmp/run.log
end PASS
INIT
chmod +x "$root/init"
(cd "$root" && find . | cpio -o -H newc --quiet | gzip -1) >"$work/initramfs.gz"

boot() {
    timeout "${STOKESCOPE_VM_SECONDS:-1200}" qemu-system-x86_64 -accel tcg -cpu max -smp 2 -m 1024 -nographic -no-reboot -nic none \
        -kernel "$vmlinuz" -initrd "$work/initramfs.gz" -append "console=ttyS0 quiet panic=-1 no_timer_check" </dev/null 2>&1 |
        stdbuf -o0 tr -d '\r' | tee "$work/vm.log" | grep --line-buffered -aE '^(PASS|FAIL|VERDICT)|offline|again' || true
}
# an emulated processor may run code that the other one is just patching, which ends the kernel at its start, before anything is tested
for _ in 1 2 3; do
    say "boot"
    boot
    grep -aq 'Oops: int3' "$work/vm.log" && ! grep -aqE '^(PASS|FAIL)' "$work/vm.log" || break
done
grep -aq '^VERDICT PASS' "$work/vm.log" || { tail -60 "$work/vm.log"; fail "in the virtual machine; see $work/vm.log"; }
say "all passed"
