#!/usr/bin/env bash
# Installs what the rigs need beyond pip (see docs/testing.md): AVR compiler, simavr, C tools, QEMU, tmux, Chromium. For Debian, as root.
set -euo pipefail
export DEBIAN_FRONTEND=noninteractive
apt-get update -qq
apt-get install -y -qq --no-install-recommends \
  gcc g++ make cppcheck libelf-dev gcc-avr avr-libc binutils-avr simavr libsimavr-dev \
  qemu-system-x86 qemu-system-arm busybox-static cpio kmod udev tmux \
  libiio0 libiio-utils >/dev/null
# The Raspberry Pi Pico's firmware: ARM compiler, its C library, and the emulator, which Node.js runs.
apt-get install -y -qq --no-install-recommends \
  gcc-arm-none-eabi binutils-arm-none-eabi picolibc-arm-none-eabi >/dev/null
command -v npm >/dev/null || apt-get install -y -qq --no-install-recommends nodejs npm >/dev/null
# The report's page in a browser: Chromium, axe-core (by npm), and the words of its PDF.
apt-get install -y -qq --no-install-recommends chromium poppler-utils fonts-dejavu-core >/dev/null
for rig in rig_rp2040 rig_browser; do
  npm ci --silent --no-audit --no-fund --prefix "$(dirname "$0")/../tests/$rig"
done
