#!/bin/sh
# First program of a machine whose root is read-only: puts a file system in memory over the root, then starts systemd.
set -e
mount -t tmpfs tmpfs /mnt
mkdir /mnt/upper /mnt/work /mnt/root
modprobe overlay
mount -t overlay -o lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work overlay /mnt/root
exec switch_root /mnt/root /sbin/init
