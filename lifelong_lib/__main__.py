"""The commands: run, compare, accept, audit, bench, test, lab. `./reproduce.sh` sets up and calls this.

Exit codes: 0 everything asked for was made; 1 something was not (a chapter failed, an audited run or a comparison
differs, a promised speed is missed); 2 the command or its input is wrong; 130 interrupted.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

try:
    from lifelong_lib.reproduction import comparison, notebooks, report
    from lifelong_lib.reproduction.children import surroundings
    from lifelong_lib.reproduction.files import ROOT, ReproductionError, alone, read_json, require
    from lifelong_lib.reproduction.grid import read_reports
    from lifelong_lib.reproduction.machine import processor, unit_costs
    from lifelong_lib.reproduction.runs import PROFILES
except ModuleNotFoundError as missing:
    print(f"error: the package {missing.name} is missing in {sys.executable}; run ./reproduce.sh", file=sys.stderr)
    sys.exit(2)


def main(arguments: list[str] | None = None) -> int:
    """Runs one command; returns the exit code. A foreseeable mistake prints one line and returns 2."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        if arguments[:1] == ["test"]:  # what follows goes to pytest; a file's tests stay in one process
            return call("pytest", "-n", "2", "--dist", "loadfile", *arguments[1:])
        options = parse(arguments)
        code = options.command(options)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        return complain("interrupted; what was stored stays, and the same command goes on from there", 130)
    except BrokenPipeError:  # as in `| head -1`: who read has heard enough, and nothing is left to do
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        return complain(f"{error.strerror or error}: {error.filename or 'while reading or writing'}", 2)
    except ReproductionError as error:
        return complain(str(error), 2)


def complain(message: str, code: int) -> int:
    print("error: " + " ".join(message.split()), file=sys.stderr)
    return code


class Parser(argparse.ArgumentParser):
    """argparse, with its complaint on one line."""

    def error(self, message: str):
        sys.exit(complain(f"{message}; see {self.prog} --help", 2))


def parse(arguments: list[str]) -> argparse.Namespace:
    """The typed command line; `command` is the function to call with it."""
    parser = Parser(prog="./reproduce.sh", description="Makes every figure, table and claim of the thesis afresh.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    profile, grids = Parser(add_help=False), Parser(add_help=False)
    profile.add_argument("--profile", choices=PROFILES, default="quick", help="how big (default: quick)")
    grids.add_argument("--chapters", type=numbers, help="chapters, as in 2,4 (default: all)")
    grids.add_argument("--workers", type=positive, help="processes at a time (default: the notebook's)")
    grids.add_argument("--backend", choices=("loky", "dask"), default="loky", help="where runs are computed")
    grids.add_argument("--address", help="the Dask scheduler, as in tcp://host:8786")

    def add(name: str, function, about: str, *parents: Parser) -> Parser:
        command = commands.add_parser(name, help=about, description=about, parents=parents, allow_abbrev=False)
        command.set_defaults(command=function)
        return command

    run = add("run", run_command, "run the notebooks, compare with the reference, write the book", profile, grids)
    run.add_argument("--seeds", type=positive, help="seeds a configuration (default: the profile's)")
    run.add_argument("--fresh", action="store_true", help="recompute what other code made, at paper too")
    run.add_argument("-p", action="append", default=[], metavar="NAME=VALUE", help="a parameter of the notebook")
    run.set_defaults(stamp=False, values=None, beside=None)
    instead = run.add_mutually_exclusive_group()
    instead.add_argument("--plan", action="store_true", help="only predict the minutes")
    instead.add_argument("--why", metavar="ID", help="only say which runs a figure, table or claim needs, as in F4.2")
    instead.add_argument("--audit", type=positive, metavar="K", help="only recompute K stored runs and compare")
    audit = add("audit", run_command, "recompute K stored runs and say if they come out the same", profile, grids)
    audit.add_argument("audit", type=positive, metavar="K")
    audit.add_argument("--stamp", action="store_true",
                       help="K runs of every grid; where all are identical, its stale runs count as made by this code")
    audit.add_argument("--beside", type=os.path.abspath, metavar="FOLDER",
                       help="with --stamp: compare with what the code that made the runs computed here with --values")
    audit.add_argument("--values", type=os.path.abspath, metavar="FOLDER",
                       help="keep what K runs of every grid come to, for --beside")
    audit.set_defaults(seeds=None, fresh=False, p=[], plan=False, why=None)
    compare = add("compare", compare_command, "two runs side by side, in words and as a page; exit 1: differs", profile)
    compare.add_argument("folders", nargs="*", type=Path, metavar="FOLDER", default=[],
                         help="what a run or `accept` wrote: A and B (default: the last run and the reference)")
    compare.add_argument("--tolerance", type=share, default=comparison.ROUNDING, metavar="T",
                         help="let numbers differ by T times the largest of their column (default: 1e-9)")
    compare.add_argument("--json", action="store_true", help="print the comparison as JSON")
    compare.add_argument("--page", type=Path, metavar="FOLDER", help="where the page goes (default: comparison, in A)")
    add("accept", accept_command, "make the last run the reference", profile)
    add("bench", lambda options: call("tests.bench"), "measure the speed ratios")  # which joins what is kept apart
    add("test", None, "run the tests; what follows goes to pytest")  # here for the help only, see main
    add("lab", lab_command, "open the notebooks in JupyterLab on this machine")
    options = parser.parse_args(arguments)
    if "backend" in options and (options.backend == "dask") != bool(options.address):
        parser.error("--address needs --backend dask, and --backend dask needs --address")
    if getattr(options, "beside", None) and not options.stamp or getattr(options, "values", None) and options.stamp:
        parser.error("--beside goes with --stamp, and --values without it")
    return options


def positive(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number above 0")
    return int(text)


def share(text: str) -> float:
    """A number from 0 to 1; argparse says what is none."""
    if not 0 <= (number := float(text)) <= 1:
        raise ValueError
    return number


def numbers(text: str) -> list[int]:
    return [positive(part.strip()) for part in text.split(",")]


def run_command(options: argparse.Namespace) -> int:
    """Checks everything that was asked for, then plans, explains, audits or runs."""
    found = notebooks.find_notebooks()
    for number in options.chapters or []:
        require(number in found, f"chapter {number} has no notebook; there are {', '.join(map(str, found))}")
    chosen = {number: path for number, path in found.items() if number in (options.chapters or found)}
    if options.why:
        chosen = {number: path for number, path in chosen.items() if options.why in notebooks.made_ids(path)}
        require(chosen, f"no notebook makes {options.why}; ids look like F4.2, T4.1 or C4.5")
    given: dict[str, object] = {"profile": options.profile}
    given |= {name: value for name in ("seeds", "workers") if (value := getattr(options, name)) is not None}
    for setting in options.p:
        name, equals, value = setting.partition("=")
        require(equals, f"-p {setting}: NAME=VALUE is wanted")
        require(name not in notebooks.COMMON, f"-p {setting}: {name} has its own option")
        given[name] = value
    typed = {number: notebooks.typed_parameters(path, given) for number, path in chosen.items()}
    if options.plan or options.why:
        return plan(options, chosen, typed)
    with alone(ROOT / "figures" / "latest" / "lock", " ".join(sys.argv[1:])):
        return (audit_runs if options.audit else run)(options, chosen, typed)


def kernel_options(options: argparse.Namespace, **more: object) -> dict:
    """What reaches run_grid; what was not asked for is left out."""
    given = {"backend": options.backend, "address": options.address, "fresh": options.fresh} | more
    return {name: value for name, value in given.items() if value}


def run(options: argparse.Namespace, chosen: dict[int, Path], typed: dict[int, dict]) -> int:
    """Executes the chapters one after another; a chapter that fails is reported and the others still run."""
    from lifelong_lib.reproduction import book  # here because Sphinx is slow to import

    folder, reference = places(options)
    finished, took = {}, {}
    for place, (number, path) in enumerate(chosen.items(), 1):
        start, title = time.time(), f"[{place}/{len(chosen)}] chapter {number}"
        print(f"{title}, {options.profile}: {path.name}", file=sys.stderr, flush=True)
        for old in (folder / "runs").glob(f"ch{number:02d}-*.json"):  # an experiment may have been renamed
            old.unlink()
        try:
            notebooks.execute(path, typed[number], folder, kernel_options(options))
            missing = notebooks.missing_results(path, folder, since=start)
            require(not missing, f"{path.name} ran, but did not make {', '.join(missing)}")
        except ReproductionError as error:
            complain(str(error), 1)
            continue
        finished[number], took[number] = typed[number], time.time() - start
        print(f"{title} made in {took[number]:.0f} s", file=sys.stderr, flush=True)
    report.write_provenance(folder, options.profile, finished, took)
    compared = comparison.compare(folder, reference)
    page = comparison.write_page(compared, folder, reference, folder / "comparison")
    index = book.build_book(folder, reference)
    print("\n".join(comparison.comparison_lines(compared)))
    counts = report.verdict_counts(read_json(folder / "claims.json", []))
    print("claims: " + ", ".join(f"{number} {verdict}" for verdict, number in counts.items()))
    print(f"comparison: {page}\nbook: {index}")
    left = ", ".join(str(number) for number in chosen if number not in finished)
    return complain(f"not made: chapter {left} (see above)", 1) if left else 0


def plan(options: argparse.Namespace, chosen: dict[int, Path], typed: dict[int, dict]) -> int:
    """--plan: minutes a grid and in all. --why ID: the grids that ID rests on. Nothing is computed or overwritten."""
    grids = look(options, chosen, typed)
    seen = {(grid.chapter, grid.name) for grid in grids}
    named = [(number, name) for number, path in chosen.items() for name in notebooks.grid_names(path)]
    unseen = [place for place in named if place not in seen]
    if options.why:
        grids = [grid for grid in grids if options.why in grid.makes]
    for grid in grids:
        minutes = "minutes unknown" if grid.seconds is None else f"{grid.seconds / 60:6.1f} min"
        print(f"chapter {grid.chapter}  {grid.name:28} {grid.wanted:5} runs: {grid.stored} stored, "
              f"{grid.stale} stale, {grid.missing} missing  {minutes}")
        for stamp, count in grid.stamps.items():
            print(f"    {count} stamped: made by other code, but {stamp}")
        for cause, count in grid.causes.items():
            print(f"    {count} stale because {cause}")
    costs = unit_costs(places(options)[1])
    guessed = sum(guess(number, name, costs, typed[number]["workers"]) for number, name in unseen)
    if options.why and not grids + unseen:
        print(f"{options.why} rests on no stored runs: its notebook computes it every time")
    known = sum(grid.seconds or 0 for grid in grids)
    if options.why:
        print(f"about {known / 60:.1f} min to compute, as far as it is known")
    else:
        known, drawing = known + guessed, sum(costs.get(f"ch{number:02d}", 0) for number in chosen)
        print(f"about {known / 60:.1f} min to compute and {drawing / 60:.1f} min to draw, as far as it is known")
    return 0


def guess(number: int, name: str, costs: dict, workers: int) -> float:
    """Prints and returns the seconds of a grid whose runs are not known yet, as many as the reference has."""
    each, runs = costs.get(f"ch{number:02d}/{name}", (0.0, 0))
    seconds = each * math.ceil(runs / workers)
    minutes = f"{seconds / 60:6.1f} min for the reference's {runs} runs" if runs else "minutes unknown"
    print(f"chapter {number}  {name:28} depends on runs that are missing; {minutes}")
    return seconds


def audit_runs(options: argparse.Namespace, chosen: dict[int, Path], typed: dict[int, dict]) -> int:
    """Recomputes `options.audit` stored runs, shared out over the chapters, or with --stamp as many of every grid.

    Returns 1 if any differs, or too few are stored.
    """
    grids = look(options, chosen, typed)
    rows = [(grid.chapter, row) for grid in grids for row in grid.audited]
    for chapter, row in rows:
        where = f"made on processor {row['made_on']}, here {processor()}"
        same = "identical" if row["compared"] else "measured times only, nothing to compare"
        said = same if row["same"] else f"DIFFERENT in {', '.join(row['differs'])} ({where})"
        print(f"chapter {chapter}  {row['run']}: {said}{' (made by older code)' * row['stale']}")
    same = sum(row["same"] for _, row in rows)
    print(f"{same} of {len(rows)} recomputed runs are identical to what is stored")
    if options.values:
        print(f"they are kept in {options.values}")
        return 0
    if options.stamp:
        return tell_stamps(grids)
    if len(rows) < options.audit:
        return complain(f"of {options.audit} runs drawn, the notebooks as they are now own only {len(rows)}", 1)
    return int(same < len(rows))


def tell_stamps(grids: list[SimpleNamespace]) -> int:
    """Prints which grids are stamped; returns 1, and names them, if runs of some came out differently."""
    for grid in grids:
        for stamp, count in grid.stamps.items():
            print(f"chapter {grid.chapter}  {grid.name}: {count} of {grid.wanted} runs are stamped: {stamp}")
    different = [f"{grid.name} of chapter {grid.chapter}" for grid in grids
                 if not all(row["same"] for row in grid.audited)]  # fmt: skip
    if different:
        return complain(f"runs came out differently, so what is stale stays so: {', '.join(different)}", 1)
    return 0


def look(options: argparse.Namespace, chosen: dict[int, Path], typed: dict[int, dict]) -> list[SimpleNamespace]:
    """Executes the notebooks into a throw-away folder; returns what run_grid said of each grid."""
    left = options.audit or 0
    with tempfile.TemporaryDirectory(prefix="lifelong-look-") as temporary:
        for place, (number, path) in enumerate(chosen.items()):
            of_every_grid = options.stamp or options.values
            share = options.audit if of_every_grid else -(-left // (len(chosen) - place))
            left -= share
            if share or not options.audit:
                print(f"looking into chapter {number}", file=sys.stderr, flush=True)
                asked = kernel_options(options, audit=share, stamp=options.stamp, plan=not options.audit,
                                       values=options.values, beside=options.beside)  # fmt: skip
                notebooks.execute(path, typed[number] | {"output_dir": temporary}, Path(temporary), asked)
        return read_reports(Path(temporary))


def compare_command(options: argparse.Namespace) -> int:
    """Compares two folders; the exit code is 1 if they differ by more than the tolerance or in a verdict."""
    folders = options.folders or places(options)
    require(len(folders) == 2, "compare takes two folders, or none for the last run and its reference")
    for folder, mend in zip(folders, ("run", "accept"), strict=True):
        hint = "" if options.folders else f"; `./reproduce.sh {mend} --profile {options.profile}` makes it"
        require(folder.is_dir(), f"{folder} is not there{hint}")
        require(any(folder.glob(report.RESULTS)), f"{folder} has no figures and no tables: it is not what a run wrote")
    found = comparison.compare(*folders, options.tolerance)
    index = comparison.write_page(found, *folders, options.page or folders[0] / "comparison")
    print(json.dumps(found, indent=1) if options.json else "\n".join(comparison.comparison_lines(found)))
    print(f"page: {index}", file=sys.stderr if options.json else sys.stdout)
    return 0 if found["same"] else 1


def accept_command(options: argparse.Namespace) -> int:
    folder, reference = places(options)
    print(f"{report.accept(folder, reference)} files are now the reference in {reference}; commit them")
    return 0


def lab_command(options: argparse.Namespace) -> int:
    as_root = ["--allow-root"] if os.geteuid() == 0 else []
    return call("jupyterlab", "--ip=127.0.0.1", *as_root, "notebooks")


def call(module: str, *arguments: str) -> int:
    return subprocess.run([sys.executable, "-m", module, *arguments], cwd=ROOT, env=surroundings()).returncode


def places(options: argparse.Namespace) -> tuple[Path, Path]:
    """Where the profile's last run and its reference are."""
    return ROOT / "figures" / "latest" / options.profile, ROOT / "figures" / "reference" / options.profile


if __name__ == "__main__":
    sys.exit(main())
