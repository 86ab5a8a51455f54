#!/bin/sh
# setup.sh run|test: finds system packages that are missing to build and run the wall (run), or also to test it (test).
# Shows the one line that installs them, asks, and installs. With YES=1 or CI set it does not ask.
set -eu

purpose=${1:-run}

has_command() { command -v "$1" >/dev/null 2>&1; }
has_library() {
    # ldconfig is in /sbin, which is not on every PATH.
    PATH="$PATH:/sbin:/usr/sbin" ldconfig -p 2>/dev/null | grep -q "$1"
}
has_vulkan_driver() {
    has_library libvulkan.so.1 && [ -n "$(find /usr/share/vulkan/icd.d /etc/vulkan/icd.d -name '*.json' 2>/dev/null)" ]
}

if has_command apt-get; then manager=apt
elif has_command dnf; then manager=dnf
elif has_command pacman; then manager=pacman
else manager=none
fi

missing=
# need NAME-ON-APT NAME-ON-DNF NAME-ON-PACMAN
need() {
    case $manager in
        apt) missing="$missing $1" ;;
        dnf) missing="$missing $2" ;;
        *) missing="$missing $3" ;;
    esac
}

has_command cc || need "gcc libc6-dev" gcc gcc
# FLIP, which compares pictures, is C++.
has_command c++ || need g++ gcc-c++ gcc
# Gamepads are found with libudev; its headers are needed to build.
{ has_command pkg-config && pkg-config --exists libudev; } \
    || need "libudev-dev pkg-config" "systemd-devel pkgconf-pkg-config" "systemd-libs pkgconf"
# Mesa's drivers include lavapipe, Vulkan on the CPU.
has_vulkan_driver || need "mesa-vulkan-drivers libvulkan1" "mesa-vulkan-drivers vulkan-loader" "vulkan-swrast vulkan-icd-loader"
has_library libxkbcommon-x11.so.0 || need libxkbcommon-x11-0 libxkbcommon-x11 libxkbcommon-x11
has_library libX11-xcb.so.1 || need libx11-xcb1 libX11-xcb libx11
has_library libXcursor.so.1 || need libxcursor1 libXcursor libxcursor
has_library libXi.so.6 || need libxi6 libXi libxi
has_library libXrandr.so.2 || need libxrandr2 libXrandr libxrandr
if [ "$purpose" = test ]; then
    # Tests find processes and send them signals.
    has_command ps && has_command kill || need procps procps-ng procps-ng
    has_command Xvfb || need xvfb xorg-x11-server-Xvfb xorg-server-xvfb
    has_command openbox || need openbox openbox openbox
    has_command xdotool || need xdotool xdotool xdotool
    # An X server with dummy monitors that tests plug and unplug.
    { has_command Xorg && [ -n "$(find /usr/lib/xorg /usr/lib64/xorg -name dummy_drv.so 2>/dev/null)" ]; } \
        || need "xserver-xorg-core xserver-xorg-video-dummy" "xorg-x11-server-Xorg xorg-x11-drv-dummy" "xorg-server xf86-video-dummy"
    # Without a browser, tests of the remote's page are skipped.
    has_command chromedriver || need "chromium chromium-driver" "chromium chromedriver" chromium
    # Fetches axe-core, which checks that everybody can use the page.
    has_command npm || need npm npm npm
    has_command import || need imagemagick ImageMagick imagemagick
fi
has_command cargo || {
    echo "setup: cargo not found: install Rust 1.95 or later from https://rustup.rs" >&2
    exit 1
}

[ -n "$missing" ] || exit 0

sudo=
[ "$(id -u)" = 0 ] || sudo="sudo "
case $manager in
    apt) update="${sudo}apt-get update -q" install="${sudo}apt-get install -y --no-install-recommends$missing" ;;
    dnf) update=: install="${sudo}dnf install -y$missing" ;;
    pacman) update=: install="${sudo}pacman -S --needed --noconfirm$missing" ;;
    none)
        echo "setup: install the equivalents of these Debian packages, then run this again:$missing" >&2
        exit 1
        ;;
esac

echo "Missing packages:$missing"
echo "To install them: $install"
[ $manager != apt ] || echo "apt may upgrade packages that these depend on; add --simulate to see which."
if [ "${YES:-}" != 1 ] && [ -z "${CI:-}" ]; then
    printf 'Install now? [Y/n] '
    read -r answer || answer=n
    case $answer in
        "" | y | Y | yes) ;;
        *) exit 1 ;;
    esac
fi
if [ $manager = apt ]; then export DEBIAN_FRONTEND=noninteractive; fi
$update >/dev/null
$install
