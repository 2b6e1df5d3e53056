# Run by firstrun.sh, before there is a network: the service of packaging/rpi does the rest at the next boot.
set -e
install -m 755 /boot/firmware/ecod/ecod-first-boot /usr/local/sbin/ecod-first-boot
install -m 644 /boot/firmware/ecod/ecod-first-boot.service /etc/systemd/system/ecod-first-boot.service
install -d /var/lib/ecod-first-boot
# The token is a password: it leaves the card's readable partition.
install -m 600 /boot/firmware/ecod/token /var/lib/ecod-first-boot/token
rm /boot/firmware/ecod/token
mv /boot/firmware/ecod/*.deb /var/lib/ecod-first-boot
systemctl enable ecod-first-boot.service
