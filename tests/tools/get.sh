#!/bin/sh
# Get a program that tests or benchmarks use, where this user may and apt-get is there; it is left
# out elsewhere, with a line that says so where tests are.
#
#     get.sh chromium | node | compiler | promtool | nats
has() { command -v "$1" >/dev/null; }

install() {
    [ "$(id -u)" = 0 ] && has apt-get && apt-get update -qq &&
        apt-get install -yqq --no-install-recommends "$@" >/dev/null
}

# As packages these would start services, so they are unpacked into the virtual environment only.
unpack() {
    folder=$1
    shift
    cd .venv || exit
    [ -d "$folder" ] || ! has apt-get || ! apt-get download -qq "$@" 2>/dev/null ||
        for package in "$@"; do dpkg -x "$package"_*.deb "$folder" && rm "$package"_*.deb; done
}

case $1 in
chromium)
    headless=/usr/bin/chromium-headless-shell
    [ -x $headless ] || install chromium-headless-shell fonts-dejavu-core
    [ -x $headless ] || [ -x /usr/bin/chromium ] ||
        echo "the tests in a browser are left out: $headless is missing"
    ;;
node) { has node && has npm; } || install nodejs npm ;;
compiler) { has cc && has c++; } || install g++ ;;
promtool) has promtool || unpack prometheus prometheus ;;
nats) has nats-server || unpack nats nats-server ;;
*) exit 2 ;;
esac
true
