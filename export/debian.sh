#!/usr/bin/env bash
# debian.sh FOLDER ARCHITECTURE [-n] PACKAGES...: packages of Debian 13 unpacked in a folder, with those that they depend on
# (-n: without), from the mirror that this system uses. Nothing is installed, and the system's package lists stay as they are.
set -euo pipefail
folder=$(realpath -m "$1") architecture=$2
shift 2
alone=false
if [ "$1" = -n ]; then alone=true && shift; fi
command -v apt-get > /dev/null || { echo "apt-get is needed: this runs on Debian and its kin" >&2; exit 1; }
own=$folder.apt
mkdir -p "$folder"/usr/{bin,lib} "$own"/{etc/{apt.conf.d,preferences.d},state/lists/partial,cache/archives/partial}
ln -sfn usr/bin "$folder/bin"
ln -sfn usr/lib "$folder/lib"
: > "$own/state/status"
mirror=$(grep -rhoE 'https?://[^ ]+/debian/?( |$)' /etc/apt/sources.list{,.d} 2> /dev/null | head -n 1 || true)
[ -n "$mirror" ] || { echo "no Debian mirror in /etc/apt" >&2; exit 1; }
echo "deb [signed-by=/usr/share/keyrings/debian-archive-keyring.gpg] $mirror trixie main" > "$own/etc/sources.list"
options=(-qq -o "Dir::Etc=$own/etc" -o "Dir::State=$own/state" -o "Dir::State::status=$own/state/status"
    -o "Dir::Cache=$own/cache" -o "APT::Architecture=$architecture" -o "APT::Architectures=$architecture"
    -o Acquire::Languages=none -o APT::Sandbox::User=root)
apt-get "${options[@]}" update
if $alone; then
    (cd "$own/cache/archives" && apt-get "${options[@]}" download "$@")
else
    apt-get "${options[@]}" --yes --download-only --no-install-recommends install "$@" > /dev/null
fi
for package in "$own"/cache/archives/*.deb; do dpkg-deb --extract "$package" "$folder"; done
