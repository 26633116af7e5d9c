"""Average the rows of a samples CSV in blocks; each dwell's last rows that fill no block are dropped.

    python examples/measured/average_blocks.py SOURCE.csv.gz BLOCKS.csv.gz --rows 20

The standard error of a block's mean is smaller than a row's scatter by the root of the block's length. Each
value is written with four decimals. The header keys of the source are kept, and the title says how many
rows were averaged.
"""

import argparse
import csv
import gzip
import io
from itertools import groupby
from pathlib import Path

import numpy as np


def average_blocks(text: str, rows: int) -> str:
    """Return the samples CSV `text` with each `rows` successive rows of one dwell averaged."""
    lines = text.splitlines()
    header_length = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    table = list(csv.DictReader(lines[header_length:]))
    names = list(table[0])
    measured = [name for name in names if name not in ("position", "angle_deg")]
    note = f"; each row is the mean of {rows} samples"
    header = [line + note if line.startswith("# title:") else line for line in lines[:header_length]]
    out = [*header, lines[header_length]]
    for _, dwell in groupby(table, key=lambda row: row["position"]):
        dwell_rows = list(dwell)
        for start in range(0, len(dwell_rows) - rows + 1, rows):
            block = dwell_rows[start : start + rows]
            means = {name: f"{np.mean([float(row[name]) for row in block]):.4f}" for name in measured}
            out.append(",".join(means.get(name, block[0][name]) for name in names))
    return "\n".join(out) + "\n"


def main() -> None:
    """Read the arguments, average, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    parser.add_argument("--rows", type=int, default=20, help="rows of a block")
    given = parser.parse_args()
    text = average_blocks(gzip.decompress(given.source.read_bytes()).decode(), given.rows)
    packed = io.BytesIO()
    # A fixed time in the header: the file is the same at each run.
    with gzip.GzipFile(filename="", mode="wb", fileobj=packed, mtime=0) as stream:
        stream.write(text.encode())
    given.target.write_bytes(packed.getvalue())


if __name__ == "__main__":
    main()
