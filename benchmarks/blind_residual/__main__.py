"""`python -m blind_residual make|run|score`, called in benchmarks/ (see README.md)."""

from __future__ import annotations

import argparse
import hashlib
import sys
from pathlib import Path

from . import harness, leaderboard
from .runners import RUNNERS


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="blind_residual", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    make = commands.add_parser("make", help="write sessions and, elsewhere, their truths")
    make.add_argument("--secret", required=True, help="what the seeds derive from; `train` for training")
    make.add_argument("--count", type=int, required=True)
    make.add_argument("--first", type=int, default=0)
    make.add_argument("--family")
    make.add_argument("--recordings", action="store_true", help="real recordings with a planted effect")
    run = commands.add_parser("run", help="run an entrant over the sessions")
    run.add_argument("name", help=f"oracle, {', '.join(RUNNERS)}, or a name for --program")
    run.add_argument("--program", help="a program that is called with a directory")
    run.add_argument("--seconds", type=float, default=float("inf"), help="begin no session after that time")
    score = commands.add_parser("score", help="write the leaderboard")
    score.add_argument("names", nargs="+")
    score.add_argument("-o", "--output", type=Path, required=True)
    score.add_argument("--records", type=Path, help="also write one JSON line a session and entrant")
    for command in (make, run, score):
        command.add_argument(
            "--work", type=Path, required=True, help="directory with sessions/, truths/, answers/"
        )
    seal = commands.add_parser("seal", help="check a secret against the published hash")
    seal.add_argument("--secret", required=True)
    return parser


def main(arguments: list[str] | None = None) -> int:
    """Run; 0 done, 1 failed, 2 wrong usage."""
    options = _parser().parse_args(arguments)
    try:
        return _run(options)
    except harness.ChallengeError as error:
        print(f"blind_residual: {error}", file=sys.stderr)
        return 1


def _run(options: argparse.Namespace) -> int:
    if options.command == "seal":
        right = hashlib.sha256(options.secret.encode()).hexdigest() == _sealed()
        print("the secret is the sealed one" if right else "the secret is not the sealed one")
        return 0 if right else 1
    sessions, truths, answered = (options.work / part for part in ("sessions", "truths", "answers"))
    if options.command == "make":
        if options.recordings:
            from . import recordings

            recordings.make(options.secret, options.count, sessions, truths)
        else:
            harness.make(options.secret, options.count, sessions, truths, options.first, options.family)
        return 0
    answered.mkdir(parents=True, exist_ok=True)
    if options.command == "run":
        if options.name not in (*RUNNERS, "oracle") and not options.program:
            raise harness.ChallengeError(f"{options.name}: not a runner that comes with it; give --program")
        bad = harness.run(
            sessions,
            truths,
            answered / f"{options.name}.jsonl",
            options.name,
            options.program,
            lambda line: print(line, file=sys.stderr),
            options.seconds,
        )
        return 1 if bad else 0
    leaderboard.write(truths, answered, options.names, options.output, options.records)
    return 0


def _sealed() -> str:
    return (Path(__file__).parent / "SEAL").read_text(encoding="utf-8").strip()


if __name__ == "__main__":
    sys.exit(main())
