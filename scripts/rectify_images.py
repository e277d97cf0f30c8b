#!/usr/bin/env python3
"""Remove the lens distortion from a batch of pictures of one camera at one zoom."""

import argparse
from pathlib import Path

import torchptz as tp
from torchptz.fleet.pictures import read_picture, write_picture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", help="the camera's table.json")
    parser.add_argument("pictures", nargs="+", type=Path, help="files")
    parser.add_argument("-o", "--out", type=Path, required=True, help="another folder")
    parser.add_argument("--zoom", type=float, default=1.0, help="magnification; 1 = widest")
    options = parser.parse_args()

    lens = tp.ZoomTable.load(options.table).at(options.zoom)
    options.out.mkdir(parents=True, exist_ok=True)
    for path in options.pictures:
        target = options.out / path.name
        if target.exists():
            parser.error(f"{target} exists already")
        write_picture(target, tp.rectify(read_picture(path), lens))


if __name__ == "__main__":
    main()
