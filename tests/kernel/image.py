"""Debian's own kernel, unpacked for QEMU, with an initramfs that mounts the host's root.

The kernel comes from the package index that apt already trusts (`apt-get download`); nothing is
installed on the host. What was built is kept in a cache folder and used again while neither the kernel's
version nor this folder's init has changed.
"""

from __future__ import annotations

import hashlib
import lzma
import os
import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent
META_PACKAGE = "linux-image-amd64"
TOOLS = {
    "qemu-system-x86_64": "qemu-system-x86",
    "busybox": "busybox-static",
    "cpio": "cpio",
    "modprobe": "kmod",
    "depmod": "kmod",
    "apt-get": "apt",
    "dpkg": "dpkg",
    "udevadm": "udev",
}
MODULES = (
    # the root: 9p over virtio under an overlay
    *("virtio_pci", "9pnet_virtio", "9p", "overlay"),
    # USB: an emulated host controller for the URB packets, a real one for QEMU's own devices
    *("vhci_hcd", "xhci_pci"),
    # what ships with the kernel for the bridges
    *("usbhid", "hid_generic", "cdc_acm", "cp210x", "ftdi_sio"),
    # an IIO accelerometer without its hardware: a HID sensor that user space makes
    *("uhid", "hid_sensor_accel_3d"),
)
LONGEST_S = 900
"""Of a step that builds the image; a download may be slow."""
XZ_MAGIC = b"\xfd7zXZ\x00"
ELF_MAGIC = b"\x7fELF"


class RigMissingError(Exception):
    """The rig cannot be built on this machine; the text says what to install or run."""


@dataclass(frozen=True)
class KernelImage:
    """What QEMU boots: an uncompressed kernel and its initramfs."""

    release: str
    kernel: Path
    initramfs: Path


def cache_folder() -> Path:
    """Folder of built images: `ADIS_GONIO_KERNEL_CACHE`, else below XDG_CACHE_HOME."""
    given = os.environ.get("ADIS_GONIO_KERNEL_CACHE")
    if given:
        return Path(given)
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "adis-gonio" / "kernel"


def kernel_image(cache: Path | None = None) -> KernelImage:
    """Fetch and build the image, or take it from the cache (shape of the name: RELEASE-DIGEST).

    Raises
    ------
    RigMissingError
        A tool or the package index is missing.
    """
    search = os.pathsep.join((os.environ.get("PATH", ""), "/usr/sbin", "/sbin"))
    missing = {package for tool, package in TOOLS.items() if shutil.which(tool, path=search) is None}
    if missing:
        raise RigMissingError(f"missing Debian packages: apt-get install {' '.join(sorted(missing))}")
    cache = cache or cache_folder()
    package = _kernel_package()
    digest = hashlib.sha256()
    for text in (package, *MODULES, (HERE / "init").read_text()):
        digest.update(text.encode() + b"\0")
    release = package.removeprefix("linux-image-")
    folder = cache / f"{release}-{digest.hexdigest()[:12]}"
    image = KernelImage(release, folder / "vmlinux", folder / "initramfs.cpio")
    if not folder.is_dir():
        cache.mkdir(parents=True, exist_ok=True)
        # Built aside and renamed: several processes may want it, and an interrupted one must not spoil it.
        with tempfile.TemporaryDirectory(dir=cache, prefix="building-") as building:
            _build(package, release, Path(building))
            ready = Path(building) / "ready"
            try:
                ready.rename(folder)
            except OSError:
                if not folder.is_dir():
                    raise
    return image


def _kernel_package() -> str:
    """Name of the package that Debian's meta package points to at present."""
    answer = _run("apt-cache", "depends", META_PACKAGE, may_fail=True)
    found = re.search(r"Depends: (linux-image-\S+-amd64)$", answer, re.MULTILINE)
    if found is None:
        raise RigMissingError(
            f"apt-cache knows no {META_PACKAGE}: run apt-get update (a Debian host is needed)"
        )
    return found[1]


def _build(package: str, release: str, folder: Path) -> None:
    ready = folder / "ready"
    ready.mkdir()
    folder.chmod(0o755)  # apt downloads as a user of its own where it can
    _run("apt-get", "download", "-q", package, cwd=folder, may_fail=True)
    packages = list(folder.glob("*.deb"))
    if not packages:
        raise RigMissingError(f"apt-get could not download {package}: run apt-get update")
    unpack = folder / "unpacked"
    unpack.mkdir()
    archive = folder / "files.tar"
    with archive.open("wb") as output:
        subprocess.run(
            ["dpkg", "--fsys-tarfile", str(packages[0])], stdout=output, check=True, timeout=LONGEST_S
        )
    _run("tar", "-x", "-f", str(archive), "-C", str(unpack), "./boot", "./lib")
    archive.unlink()
    _unpack_vmlinux(unpack / "boot" / f"vmlinuz-{release}", ready / "vmlinux")
    _run("depmod", "-b", str(unpack), release)
    _build_initramfs(unpack, release, ready / "initramfs.cpio")


def _unpack_vmlinux(bzimage: Path, vmlinux: Path) -> None:
    """Take the ELF kernel out of a bzImage: QEMU boots it several seconds sooner."""
    packed = bzimage.read_bytes()
    start = packed.find(XZ_MAGIC)
    while start >= 0:
        try:
            kernel = lzma.LZMADecompressor().decompress(packed[start:])
        except lzma.LZMAError:
            kernel = b""
        if kernel.startswith(ELF_MAGIC):
            vmlinux.write_bytes(kernel)
            return
        start = packed.find(XZ_MAGIC, start + 1)
    raise RigMissingError(f"{bzimage.name}: no xz-compressed kernel inside")


def _build_initramfs(unpack: Path, release: str, target: Path) -> None:
    root = unpack.parent / "initramfs"
    for name in ("bin", "dev", "lower", "modules", "proc", "root", "sys", "upper"):
        (root / name).mkdir(parents=True)
    shutil.copy(Path(shutil.which("busybox") or "/bin/busybox"), root / "bin" / "busybox")
    shutil.copy(HERE / "init", root / "init")
    (root / "init").chmod(0o755)
    lines = _run("modprobe", "-d", str(unpack), "-S", release, "--show-depends", "-a", *MODULES)
    names: list[str] = []
    for line in lines.splitlines():
        if line.startswith("insmod "):
            module = Path(line.split()[1])
            if module.name not in names:
                names.append(module.name)
                shutil.copy(module, root / "modules" / module.name)
    (root / "modules" / "order").write_text("".join(f"{name}\n" for name in names))
    listing = "\0".join(str(path.relative_to(root)) for path in sorted(root.rglob("*")))
    with target.open("wb") as output:
        subprocess.run(
            ["cpio", "--create", "--null", "--quiet", "--format=newc", "--owner=0:0"],
            cwd=root,
            input=listing.encode(),
            stdout=output,
            check=True,
            timeout=LONGEST_S,
        )


def _run(*command: str, cwd: Path | None = None, may_fail: bool = False) -> str:
    environment = {**os.environ, "LC_ALL": "C", "PATH": os.environ.get("PATH", "") + ":/usr/sbin:/sbin"}
    done = subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, check=False, timeout=LONGEST_S
    )
    if done.returncode and not may_fail:
        raise RigMissingError(f"{command[0]} failed: {done.stderr.strip().splitlines()[-1:]}")
    return done.stdout
