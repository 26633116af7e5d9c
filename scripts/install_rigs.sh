#!/usr/bin/env bash
# Installs what the rigs need beyond pip (see docs/testing.md): AVR and ARM compilers, C tools, QEMU, rp2040js. For Debian, as root.
set -euo pipefail
export DEBIAN_FRONTEND=noninteractive
apt-get update -qq
apt-get install -y -qq --no-install-recommends \
  gcc g++ make cppcheck libelf-dev gcc-avr avr-libc binutils-avr \
  gcc-arm-none-eabi binutils-arm-none-eabi picolibc-arm-none-eabi \
  qemu-system-x86 busybox-static cpio kmod udev >/dev/null
command -v npm >/dev/null || apt-get install -y -qq --no-install-recommends nodejs npm >/dev/null
npm ci --silent --no-audit --no-fund --prefix "$(dirname "$0")/../tests/rig_rp2040"
