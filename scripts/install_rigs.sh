#!/usr/bin/env bash
# Installs what the rigs need beyond pip (see docs/testing.md): AVR compiler, simavr, C tools, QEMU. For Debian, as root.
set -euo pipefail
export DEBIAN_FRONTEND=noninteractive
apt-get update -qq
apt-get install -y -qq --no-install-recommends \
  gcc g++ make cppcheck libelf-dev gcc-avr avr-libc binutils-avr simavr libsimavr-dev \
  qemu-system-x86 busybox-static cpio kmod udev \
  libiio0 libiio-utils >/dev/null
