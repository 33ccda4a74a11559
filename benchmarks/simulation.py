"""Speed of simulating drives: pictures per second, stage by stage, on one core.

No peer renders these scenes without a GPU. Each stage is printed as a fraction of the total, and
OpenCV's JPEG encoding of the same picture is the unit for comparing machines.

    python benchmarks/simulation.py
"""

from __future__ import annotations

import argparse
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2

from crosscue.datasets.scenes.drive import jpeg, write_scene
from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.rendering.render import Renderer
from crosscue.datasets.scenes.settings import SceneSettings, world_of


def cpu_s(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--pictures", type=int, default=12, help="of each layout, a round")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    print("CPU seconds, median of rounds; 1280x720, 2x2 samples a pixel on edges\n")
    print("layout  build   picture    JPEG  pictures/s  JPEGs a picture")
    for name in "CEH":
        settings = SceneSettings(name, 1)
        build = cpu_s(lambda settings=settings: world_of(settings))  # type: ignore[misc]
        _, _, world = world_of(settings)
        renderer = Renderer(world)
        last_s = len(world.approach.motion) / 100.0
        renderer.picture(0.0)
        drawing, coding = [], []
        for _ in range(args.rounds):
            times = [last_s * k / args.pictures for k in range(args.pictures)]
            spent = 0.0
            for k, t_s in enumerate(times):
                began = time.process_time()
                picture = renderer.picture(t_s, k)
                drawing.append(time.process_time() - began)
                spent += cpu_s(lambda picture=picture: jpeg(picture.rgb, 90))  # type: ignore[misc]
            coding.append(spent / len(times))
        draw, code = statistics.median(drawing), statistics.median(coding)
        print(
            f"{name:6} {build:6.2f} {draw:9.4f} {code:7.4f} {1 / (draw + code):11.1f} "
            f"{draw / code:16.1f}"
        )
    with TemporaryDirectory() as folder:
        began = time.process_time()
        files = write_scene(Path(folder) / "drive", SceneSettings("C", 1, camera=SceneCamera()))
        spent = time.process_time() - began
        size = files.log.stat().st_size / 1e6
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    rate = files.pictures / spent
    print(f"\na whole drive: {files.pictures} pictures, {files.seconds:.0f} s, {size:.0f} MB")
    print(f"{spent:.1f} CPU s = {rate:.1f} pictures/s; peak memory {peak:.0f} MiB")


if __name__ == "__main__":
    main()
