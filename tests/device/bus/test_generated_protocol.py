import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
GENERATED = ("firmware_proto/core/gonio_protocol.h", "src/adis_gonio/device/bus/wire/protocol.py")
CRC_TABLE = "firmware_proto/core/gonio_crc_table.h"


def run(root: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    script = root / "scripts" / "generate_protocol.py"
    return subprocess.run(
        [sys.executable, str(script), *arguments], capture_output=True, text=True, check=False, timeout=60
    )


def copy(folder: Path) -> Path:
    for name in ("scripts/generate_protocol.py", "firmware_proto/protocol.toml", CRC_TABLE, *GENERATED):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes((ROOT / name).read_bytes())
    return folder


def test_header_and_module_are_what_the_table_says():
    done = run(ROOT, "--check")
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_changed_table_is_noticed_in_both_files_and_mended(tmp_path):
    root = copy(tmp_path)
    table = root / "firmware_proto" / "protocol.toml"
    table.write_text(table.read_text().replace("version = 1", "version = 2"))
    done = run(root, "--check")
    assert done.returncode == 1
    assert all(name in done.stdout for name in GENERATED)
    assert CRC_TABLE not in done.stdout
    assert run(root).returncode == 0
    assert run(root, "--check").returncode == 0


def test_a_type_that_stands_twice_is_refused(tmp_path):
    root = copy(tmp_path)
    table = root / "firmware_proto" / "protocol.toml"
    table.write_text(table.read_text().replace("type = 0x06", "type = 0x05"))
    assert "twice" in run(root).stderr
