"""What an entrant answers, and the check that an answer is one."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any


class AnswerError(ValueError):
    """An entrant's answer breaks the contract; one line that says where and what to do."""


def empty() -> dict[str, Any]:
    """The answer of who sees nothing."""
    return {"something": 0.0, "causes": [], "covariates": [], "base": {}, "heldout": {}, "notes": {}}


def load(path: Path) -> dict[str, Any]:
    """Read and check an answer file.

    Raises
    ------
    AnswerError
        No file, no JSON, or something in it that the contract does not allow.
    """
    try:
        answer = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise AnswerError(f"{path.name}: the runner wrote no such file") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise AnswerError(f"{path.name}: no JSON ({error})") from None
    return checked(answer, path.name)


def checked(answer: Any, where: str = "answer") -> dict[str, Any]:
    """The answer with absent keys filled in.

    Raises
    ------
    AnswerError
    """

    def need(truth: bool, what: str) -> None:
        if not truth:
            raise AnswerError(f"{where}: {what}")

    need(isinstance(answer, dict), "the answer must be one JSON object")
    unknown = set(answer) - set(empty())
    need(
        not unknown,
        f"unknown key {sorted(unknown)[0] if unknown else ''!r}; known are {', '.join(empty())}",
    )
    answer = empty() | answer
    need(_share(answer["something"]), "`something` must be a probability from 0 to 1")
    need(isinstance(answer["causes"], list), "`causes` must be a list")
    for k, cause in enumerate(answer["causes"]):
        here = f"causes[{k}]"
        need(
            isinstance(cause, dict) and isinstance(cause.get("names"), list), f"{here} needs a list `names`"
        )
        names, probability = cause["names"], cause.get("probability")
        need(
            bool(names) and all(isinstance(n, str) for n in names),
            f"{here}.names must hold at least one name",
        )
        need(
            isinstance(probability, list)
            and len(probability) == len(names)
            and all(map(_share, probability)),
            f"{here}.probability must be one number from 0 to 1 a name",
        )
        _check_values(cause.setdefault("parameters", {}), f"{here}.parameters", need)
    words = answer["covariates"]
    need(
        isinstance(words, list) and all(isinstance(w, str) for w in words),
        "`covariates` must be a list of words",
    )
    _check_values(answer["base"], "base", need)
    need(isinstance(answer["heldout"], dict), "`heldout` must be an object, see README.md")
    return answer


def _share(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value <= 1


def _check_values(values: Any, where: str, need: Any) -> None:
    need(isinstance(values, dict), f"{where} must be an object of name: {{value, u}}")
    for name, pair in values.items():
        good = isinstance(pair, dict) and all(
            isinstance(pair.get(key), int | float) and math.isfinite(pair[key]) for key in ("value", "u")
        )
        need(good and pair["u"] >= 0, f"{where}.{name} needs finite numbers `value` and `u`, u not below 0")
