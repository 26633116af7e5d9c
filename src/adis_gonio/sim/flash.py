"""A simulated part's flash in a file, so that it outlives the process as a real one outlives its power."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from adis_gonio.base.errors import UsageError
from adis_gonio.base.output import replacing
from adis_gonio.sim.memory import ENDURANCE_WRAP


@dataclass(frozen=True)
class FlashFile:
    """Words of the flash and ENDURANCE as JSON; made with the first flash update.

    Attributes
    ----------
    path : Path
    part : str
        Variant and seed of the part: the file of another one is refused.
    """

    path: Path
    part: str

    def read(self) -> tuple[dict[str, int], int]:
        """Words by register, and ENDURANCE; of a new part where there is no file.

        Raises
        ------
        UsageError
            The file is none of these, is damaged, or belongs to another part.
        """
        try:
            document = json.loads(self.path.read_text(encoding="utf-8"))
            owner = str(document["part"])
            words = {str(name): int(word) for name, word in document["flash"].items()}
            endurance = int(document["endurance"])
        except FileNotFoundError:
            return {}, 0
        except OSError as error:
            raise UsageError(f"flash: {self.path}: cannot be read: {error.strerror or error}") from error
        except (ValueError, KeyError, TypeError, AttributeError):
            raise UsageError(f"flash: {self.path}: is no flash of a simulated part; name another") from None
        if owner != self.part:
            raise UsageError(f"flash: {self.path}: is that of {owner}, this is {self.part}; name another")
        if not 0 <= endurance < ENDURANCE_WRAP:
            raise UsageError(f"flash: {self.path}: its ENDURANCE {endurance} is not possible; name another")
        return words, endurance

    def write(self, words: Mapping[str, int], endurance: int) -> None:
        """Keep what a flash update has saved; whole or not at all."""
        document = {"part": self.part, "endurance": endurance, "flash": dict(words)}
        with replacing(self.path) as beside:
            beside.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
