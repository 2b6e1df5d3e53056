# firstrun.sh runs this script before the network is up; the service of packaging/rpi completes the installation at the next boot. After
# a power failure firstrun.sh runs this script again: files are removed from the boot partition only after they are on the Pi's own.
set -eu
from=/boot/firmware/ecod
to=/var/lib/ecod-first-boot
# Writes an error to the journal, and to the card next to the token.
exec 3>&2 2>"$from/problem.txt"
trap 'cat "$from/problem.txt" >&3' EXIT

# The token goes first from the boot partition: where it is, all else is, too.
if [ -e "$from/token" ] || ! [ -e "$to/token" ]; then
    # Editors add spaces, other ends of lines, or a byte order mark.
    token=$(tr -cd 'A-Za-z0-9_-' <"$from/token") || token=
    case $token in
    ecod1-?*) ;;
    *) echo "$from/token is no token of ecod-node invite, which begins with ecod1-: run packaging/rpi/prepare again" >&2 && exit 1 ;;
    esac
    rm -rf "$to"
    install -d -m 700 "$to"
    cp "$from"/*.deb "$to"
    echo "$token" >"$to/token"
    install -m 755 "$from/ecod-first-boot" /usr/local/sbin/ecod-first-boot
    install -m 644 "$from/ecod-first-boot.service" /etc/systemd/system/ecod-first-boot.service
    systemctl enable --quiet ecod-first-boot.service
    sync
    # It is a password, and any machine can read this partition.
    rm -f "$from/token"
    sync
fi
rm -f "$from"/*.deb "$from/problem.txt"
trap - EXIT
