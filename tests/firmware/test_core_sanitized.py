"""The core under the sanitizers; scripts/fuzz_wire.py runs it for longer."""

import re
import shutil
import subprocess

import pytest

from firmware.host_core import HOST

BYTES = 1_000_000


def run(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.parametrize("seed", [1, 2])
def test_random_bytes_and_broken_requests_crash_nothing_and_send_no_write(host_build, seed):
    told = run(str(host_build("fuzz")), str(BYTES), str(seed))
    fed, packets, frames = (int(number) for number in re.findall(r"\d+", told))
    assert fed >= BYTES
    assert packets > 1000
    assert frames > 10_000


def test_the_c_core_agrees_with_the_shared_vectors(host_build):
    told = run(str(host_build("vectors")), str(HOST.parent / "vectors.txt"))
    assert re.fullmatch(r"\d+ vectors, 0 wrong\n", told)


def test_static_analysis_finds_nothing_in_core_and_port():
    if shutil.which("cppcheck") is None:
        pytest.skip("cppcheck is not installed (Debian: cppcheck)")
    run("make", "-s", "-C", str(HOST), "check")


def test_the_c_core_notices_a_wrong_vector(host_build, tmp_path):
    wrong = tmp_path / "wrong.txt"
    wrong.write_text("crc 313233343536373839 29b2\n")
    done = subprocess.run(
        [str(host_build("vectors")), str(wrong)], capture_output=True, check=False, timeout=60
    )
    assert done.returncode == 1
