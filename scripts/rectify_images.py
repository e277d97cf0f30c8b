#!/usr/bin/env python3
"""Remove the lens distortion from a batch of pictures of one camera at one zoom."""

import argparse
import sys
from pathlib import Path

import torchptz as tp
from torchptz.fleet.pictures import rectify_pictures


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", help="the camera's table.json")
    parser.add_argument("pictures", nargs="+", type=Path, help="files, or folders of pictures")
    parser.add_argument("-o", "--out", type=Path, required=True, help="another folder")
    parser.add_argument("--zoom", type=float, default=1.0, help="magnification; 1 = widest")
    options = parser.parse_args()

    try:
        table = tp.ZoomTable.load(options.table)
        # Several pictures are decoded, rectified and encoded at once, one a core.
        done = rectify_pictures(table, options.pictures, options.out, zoom=options.zoom)
    except (OSError, ValueError) as error:
        print(error, file=sys.stderr)
        return 2
    for path, reason in done.failed.items():
        print(f"{path}: {reason}", file=sys.stderr)
    print(f"{len(done.written)} pictures rectified into {options.out}")
    return 0 if not done.failed else 1 if done.written else 2


if __name__ == "__main__":
    sys.exit(main())
