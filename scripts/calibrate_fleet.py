#!/usr/bin/env python3
"""Calibrate every camera of a fleet: one table of lenses, over zoom, for each."""

import argparse
import sys
from pathlib import Path

from torchptz.cli.printing import print_summary
from torchptz.fleet.calibrate import calibrate
from torchptz.fleet.config import ConfigError
from torchptz.fleet.progress import Stages


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config", help="the fleet, such as configs/fleet.yaml")
    parser.add_argument("out", type=Path, help="folder of the run, such as runs/demo")
    parser.add_argument("--powers", type=float, nargs="+", default=[1, 2, 3], help="of r in L")
    options = parser.parse_args()

    progress = Stages(lambda line: print(line, file=sys.stderr))
    try:
        summary = calibrate(options.config, options.out, options.powers, progress)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    print_summary(summary, options.out)
    return 0 if summary.all_ok else 2 if summary.none_ok else 1


if __name__ == "__main__":
    sys.exit(main())
