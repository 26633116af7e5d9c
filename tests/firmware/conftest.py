"""Fixtures of the firmware's tests: the core on the host, and the rig around the real binary."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from adis_gonio.device.bus.wire.protocol import BAUD
from firmware import avr_build, host_core, pico_build
from firmware.client import Client
from firmware.host_core import HostCore


@cache
def _folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="gonio-firmware-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@pytest.fixture(scope="session")
def host_build() -> Callable[[str], Path]:
    """Builds a product of the host's Makefile."""
    reason = host_core.missing()
    if reason:
        pytest.skip(reason)
    return lambda target: host_core.build(_folder(), target)


@pytest.fixture
def core(host_build: Callable[[str], Path]) -> Iterator[HostCore]:
    """The core after power-on, no session open."""
    core = HostCore(host_build("libgonio.so"))
    yield core
    assert core.lock_errors == 0


@pytest.fixture
def client(core: HostCore) -> Client:
    """A host with an open session."""
    client = Client(core, timeout_s=5)
    client.hello()
    return client


@pytest.fixture
def avr_elf() -> Callable[..., Path]:
    """Builds the firmware for options such as BAUD=1000000."""
    reason = avr_build.missing()
    if reason:
        pytest.skip(reason)
    return lambda **options: avr_build.elf(_folder(), **options)


@pytest.fixture
def make_rig(avr_elf: Callable[..., Path]) -> Iterator[Callable[..., Any]]:
    """Builds rigs, and judges every frame that their pins have seen."""
    from firmware.rig import Rig

    rigs = []

    def make(world: Any, *, chip: Any = None, **options: int) -> Rig:
        rigs.append(Rig(avr_elf(**options), world, chip, baud=options.get("BAUD", BAUD)))
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.check()


@pytest.fixture
def pico_uf2() -> Callable[..., Path]:
    """Builds the Pico's firmware for options such as PID="0x0002"."""
    reason = pico_build.missing()
    if reason:
        pytest.skip(reason)
    return lambda **options: pico_build.uf2(_folder(), **options)


@pytest.fixture
def make_pico(pico_uf2: Callable[..., Path]) -> Iterator[Callable[..., Any]]:
    """Builds Picos with options of their chip, and judges every frame that their pins have seen."""
    from firmware.pico_rig import PicoRig

    rigs: list[PicoRig] = []

    def make(image: Path | None = None, **chip: Any) -> PicoRig:
        rigs.append(PicoRig(image or pico_uf2(), **chip))
        rigs[-1].sleep_s(0.1)  # start-up and the host's enumeration
        return rigs[-1]

    yield make
    try:
        for rig in rigs:
            rig.check()
    finally:
        for rig in rigs:
            rig.close()
