#!/usr/bin/env python3
"""Remove the lens distortion from a batch of pictures of one camera at one zoom."""

import argparse
from pathlib import Path

import cv2
import numpy as np

import torchptz as tp


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", help="the camera's table.json")
    parser.add_argument("pictures", nargs="+", type=Path, help="files of one size")
    parser.add_argument("-o", "--out", type=Path, required=True, help="another folder")
    parser.add_argument("--zoom", type=float, default=1.0, help="magnification; 1 = widest")
    options = parser.parse_args()

    lens = tp.ZoomTable.load(options.table).at(options.zoom)
    frames = np.stack([cv2.imread(str(path)) for path in options.pictures])
    options.out.mkdir(parents=True, exist_ok=True)
    for path, frame in zip(options.pictures, tp.rectify(frames, lens), strict=True):
        target = options.out / path.name
        if target.exists():
            parser.error(f"{target} exists already")
        cv2.imwrite(str(target), frame)


if __name__ == "__main__":
    main()
