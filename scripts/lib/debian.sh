# shellcheck shell=bash
# Debian's packages, for scripts to source: those of the machine's own suite, and single ones of another.

# debian_need LOG PACKAGE…: installs what is missing, as root or through sudo.
debian_need() {
    local log=$1 missing=() root=()
    shift
    for package; do dpkg -s "$package" >/dev/null 2>&1 || missing+=("$package"); done
    [ ${#missing[@]} = 0 ] && return
    echo "== install ${missing[*]}" >&2
    [ "$(id -u)" = 0 ] || root=(sudo -n)
    local install=("${root[@]}" apt-get -o DPkg::Lock::Timeout=300 install -y --no-install-recommends "${missing[@]}")
    "${install[@]}" >"$log" 2>&1 || { "${root[@]}" apt-get update >>"$log" 2>&1 && "${install[@]}" >>"$log" 2>&1; } ||
        { echo "these packages are needed: ${missing[*]} (see $log)" >&2; return 1; }
}

# debian_suite FOLDER KIND SUITE [OPTION]: package lists of SUITE from the mirror that this machine's apt uses; KIND is deb or
# deb-src, OPTION as in a source list. They lie in FOLDER, so that the machine's own stay as they are; the array `suite`
# holds the options with which apt-get and apt-cache use them.
debian_suite() {
    local folder=$1 mirror
    mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' | grep -m1 '/debian/*$') ||
        { echo "apt names no Debian mirror" >&2; return 1; }
    mkdir -p "$folder"/{lists,cache}/partial "$folder/cache/archives/partial"
    echo "$2 [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg ${4:-}] $mirror $3 main" >"$folder/sources.list"
    suite=(-o "Dir::Etc::sourcelist=$folder/sources.list" -o Dir::Etc::sourceparts=- -o "Dir::State::lists=$folder/lists"
        -o "Dir::Cache=$folder/cache")
    apt-get "${suite[@]}" update >"$folder/update.log" 2>&1 ||
        { echo "no package lists of $3 (see $folder/update.log)" >&2; return 1; }
}

# debian_foreign QEMU: programs of another processor start like this machine's own. Debian's qemu brings the line that the kernel needs; where
# no service has given it, root does it here.
debian_foreign() {
    local kernel=/proc/sys/fs/binfmt_misc line=/usr/lib/binfmt.d/$1.conf
    [ -e "$kernel/register" ] || mount -t binfmt_misc binfmt_misc "$kernel" 2>/dev/null || true
    [ -e "$kernel/$1" ] || cat "$line" >"$kernel/register" 2>/dev/null || true
    [ -e "$kernel/$1" ] || { echo "only root can ask the kernel to start them ($line)" >&2; return 1; }
}
