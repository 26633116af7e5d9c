"""One run of the guest: a job in, console text, exit status and files out."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from kernel.image import HERE, KernelImage

KILL_AFTER_S = 5
FIRST = ("nice", "-n", "-8")
"""Time-outs in the guest are real, so it and its board go before other tests if the user may do that."""


@dataclass(frozen=True)
class GuestRun:
    """What a run left.

    Attributes
    ----------
    status : int or None
        Exit status of the job; None where the guest did not come to its end.
    console : str
        All that the guest wrote to its console, kernel and job alike.
    elapsed_s : float
        Host time from start to end.
    """

    status: int | None
    console: str
    elapsed_s: float


def run_in_guest(
    image: KernelImage,
    share: Path,
    job: Sequence[str],
    *,
    environment: dict[str, str],
    work_folder: Path,
    open_to_all: Sequence[Path] = (),
    job_time_s: int = 150,
    qemu_options: Sequence[str] = (),
) -> GuestRun:
    """Boot, run `job` as root within its time, stop.

    Parameters
    ----------
    share : Path
        Folder of the host, seen in the guest as /guest, writable.
    work_folder : Path
        Where the job starts; the guest sees the host's root, so paths are the same.
    open_to_all : sequence of Path
        Files of the host that the guest's ordinary user must reach too: their parent folders are made
        passable (in the guest's overlay, never on the host).
    qemu_options : sequence of str
        More devices, such as QEMU's own USB serial adapter.
    """
    shutil.copy(HERE / "start.sh", share / "start.sh")
    passable = sorted({str(folder) for path in open_to_all for folder in (path, *path.parents)})
    lines = [f"export {name}={shlex.quote(value)}" for name, value in environment.items()]
    lines += [f"chmod a+rx {shlex.quote(folder)}" for folder in passable if folder != "/"]
    lines.append(f"cd {shlex.quote(str(work_folder))}")
    lines.append(f"timeout -k {KILL_AFTER_S} {job_time_s} {shlex.join(job)}")
    lines.append("status=$?")
    (share / "job.sh").write_text("".join(f"{line}\n" for line in lines))
    command = [
        *FIRST,
        *("qemu-system-x86_64", "-accel", "tcg", "-M", "q35", "-cpu", "max", "-smp", "1", "-m", "1024"),
        *("-nodefaults", "-display", "none", "-no-reboot", "-serial", "stdio"),
        *("-kernel", str(image.kernel), "-initrd", str(image.initramfs)),
        *(
            "-append",
            "console=ttyS0 quiet loglevel=4 panic=-1 mitigations=off tsc=reliable random.trust_cpu=on",
        ),
        *("-virtfs", "local,path=/,mount_tag=root,security_model=none,readonly=on,multidevs=remap"),
        *("-virtfs", f"local,path={share},mount_tag=share,security_model=none"),
        *qemu_options,
    ]
    start = time.monotonic()
    with (share / "console.txt").open("wb") as console:
        machine = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=console, stderr=subprocess.STDOUT
        )
        try:
            machine.wait(timeout=job_time_s + 60)
        except subprocess.TimeoutExpired:
            machine.kill()
            machine.wait(60)
    status = share / "rc"
    return GuestRun(
        status=int(status.read_text()) if status.exists() and status.read_text().strip() else None,
        console=(share / "console.txt").read_text(errors="replace"),
        elapsed_s=time.monotonic() - start,
    )
