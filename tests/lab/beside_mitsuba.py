"""Compares path-traced pictures with those of Mitsuba 3, at equal light: the same triangles, camera, sun, sky and albedo.

    make mitsuba MODEL=dragon.ply MITSUBA_OPTIONS="--camera dragon.full.toml"

Mitsuba is by other people and shares no code with Raywall. The comparison of light prints, for blocks of 64x64 pixels, the
difference of the means in standard errors, which come from independent pictures of each renderer, and the PSNR of the means. It
ends with status 1 if more blocks differ than chance allows. The comparison of times has Raywall and variants of Mitsuba render
in turns, on one thread, and prints the CPU time that each needs to the same error. --points writes Mitsuba's CPU time and error
with 1, 4, 16 ... samples as CSV, which `lab chart --charts light --points FILE` draws beside Raywall's.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
import time

import numpy as np

import mitsuba_scene

BLOCK = 64


class Raywall:
    """Renders independent pictures, each a process or several in one."""

    def __init__(self, args):
        self.out = os.path.join(args.folder, f"raywall-{os.getpid()}.json")
        self.command = [args.raywall, "--model", args.model, "--crease", "0", "--rays", "path", "--threads", "1", "--size", args.size]
        self.command += ["--bounces", str(args.bounces), "--samples", str(args.samples), "--out", self.out]
        self.command += ["--camera", args.camera] if args.camera else []

    def render(self, first, n=1):
        """The pictures from this number on, top row first, their mean CPU time, and the description of the scene."""
        numbers = ["--first-picture", str(first), "--pictures", str(n)]
        if subprocess.run(self.command + numbers, stdout=subprocess.DEVNULL).returncode:
            sys.exit(f"{self.command[0]} made no picture of {self.command[2]}: its own line above says why")
        with open(self.out) as file:
            scene = json.load(file)
        light = self.out.replace(".json", ".f32")
        pixels = np.fromfile(light, "<f4").reshape(n, scene["height"], scene["width"], 3)
        os.remove(self.out)
        os.remove(light)
        return pixels[:, ::-1].astype(float), np.mean(scene["cpu_s"]), scene


class Mitsuba:
    """Renders with a variant of Mitsuba on one thread; rays start beside surfaces by `part` of its distance, if one is given."""

    def __init__(self, args, variant, scene, part=None):
        import mitsuba as mi

        mi.set_variant(variant)
        import drjit as dr

        dr.set_thread_count(1)
        self.mi, self.variant = mi, variant
        self.scene = mitsuba_scene.load(mi, scene, args.mitsuba_model or args.model, args.texture, args.roulette)
        self.integrator = self.scene.integrator() if part is None else mitsuba_scene.near_paths(mi, args.bounces, part)

    def render(self, seed, samples):
        """A picture and its CPU time. The first picture of a number of samples also compiles kernels."""
        self.mi.set_variant(self.variant)
        start = time.process_time()
        picture = np.array(self.mi.render(self.scene, integrator=self.integrator, seed=seed, spp=samples))
        return picture.astype(float)[:, :, :3], time.process_time() - start


def blocks(pictures):
    """The means of blocks of each picture."""
    n, height, width = len(pictures), pictures.shape[1] // BLOCK, pictures.shape[2] // BLOCK
    whole = pictures[:, :height * BLOCK, :width * BLOCK]
    return whole.reshape(n, height, BLOCK, width, BLOCK, 3).mean(axis=(2, 4))


def variance_of_mean(values):
    """The variance of the mean of independent pictures' values."""
    return np.var(values, axis=0, ddof=1) / len(values)


def psnr(difference):
    """In decibels, of pictures whose brightest value is 1."""
    return -10 * np.log10(np.mean(difference**2))


def encoded(light):
    """The sRGB values, from 0 to 1, of linear light."""
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def compare_light(args, raywall):
    """Prints the differences of the means; whether they are chance."""
    ours, _, scene = raywall.render(0, args.pictures)
    mitsuba = Mitsuba(args, "llvm_ad_rgb", scene, args.part)
    theirs = np.stack([mitsuba.render(seed, args.samples)[0] for seed in range(args.pictures)])

    means = ours.mean(axis=0), theirs.mean(axis=0)
    lit = np.maximum(*means).max(axis=2) > 0
    light = means[1][lit].mean()
    difference = (blocks(means[0][None]) - blocks(means[1][None]))[0]
    error = np.sqrt(variance_of_mean(blocks(ours)) + variance_of_mean(blocks(theirs)))
    seen = error > 0
    deviation = np.abs(difference[seen] / error[seen])
    # Few pictures tell their own variance only roughly: Student's distribution.
    freedom = 2 * (args.pictures - 1)
    by_chance = np.sqrt(freedom / (freedom - 2)) if freedom > 2 else np.inf
    n, within = seen.sum(), (deviation <= 3).sum()
    print(f"light: {args.pictures} pictures of {args.samples} samples each, {100 * lit.mean():.0f} % of the pixels show the model")
    print(f"  {n} means of blocks and channels: {within} within 3 standard errors, largest {deviation.max():.2f}, "
          f"RMS {np.sqrt(np.mean(deviation**2)):.2f} (by chance {by_chance:.2f})")
    print(f"  of the model's mean light: largest difference of a block {100 * np.abs(difference).max() / light:.3f} %, "
          f"of all light {100 * (means[0][lit].mean() / light - 1):+.4f} %")
    for name, (a, b) in (("linear light", means), ("sRGB", tuple(map(encoded, means)))):
        print(f"  PSNR of {name}, {args.pictures * args.samples} samples: {psnr(a - b):.1f} dB, "
              f"of the model's pixels {psnr((a - b)[lit]):.1f} dB")
    # By chance 0.5 % lie beyond three, mostly with all three channels of a block.
    return n - within <= max(3, 0.03 * n)


def compare_times(args, raywall):
    """Prints the CPU times to the same error."""
    _, _, scene = raywall.render(0)
    variants = [Mitsuba(args, variant, scene) for variant in args.variants.split(",")]
    # Powers of four make as many strata across as down. The last number is compared.
    counts = [4**n for n in range(16) if 4**n < args.samples] if args.points else []
    counts.append(args.samples)
    ours, theirs = [], {(mitsuba, count): [] for count in counts for mitsuba in variants}
    for mitsuba, count in theirs:
        mitsuba.render(args.rounds, count)
    for number in range(args.rounds):
        pixels, cpu_s, _ = raywall.render(number)
        ours.append((pixels[0], cpu_s))
        for (mitsuba, count), pictures in theirs.items():
            pictures.append(mitsuba.render(number, count))
    lit = np.mean([picture for picture, _ in ours], axis=0).max(axis=2) > 0

    def time_and_error(pictures):
        """The mean CPU time and the RMSE of one picture, over the pixels that show the model."""
        variance = np.var([picture for picture, _ in pictures], axis=0, ddof=1)
        return np.mean([cpu_s for _, cpu_s in pictures]), np.sqrt(variance[lit].mean())

    cpu_s, rmse = time_and_error(ours)
    print(f"times: {args.rounds} pictures of {args.samples} samples, in turns; raywall: {cpu_s:.2f} s of CPU time, RMSE {rmse:.5f}")
    points = []
    for (mitsuba, count), pictures in theirs.items():
        their_cpu_s, their_rmse = time_and_error(pictures)
        points.append((f"Mitsuba {mitsuba.variant}", count, 1e3 * their_cpu_s, their_rmse))
        if count == args.samples:
            # The square of the error falls as the time grows.
            ratios = [ours[at][1] * rmse**2 / (pictures[at][1] * their_rmse**2) for at in range(args.rounds)]
            print(f"  {mitsuba.variant}: {their_cpu_s:.2f} s, RMSE {their_rmse:.5f}; to the same error raywall takes "
                  f"{cpu_s * rmse**2 / (their_cpu_s * their_rmse**2):.2f} of its CPU time ({min(ratios):.2f} to {max(ratios):.2f})")
    if args.points:
        with open(args.points, "w", newline="") as file:
            csv.writer(file).writerows([("name", "samples", "cpu_ms", "light_rmse"), *points])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--mitsuba-model", help="a PLY file with the same triangles, if Mitsuba cannot read the model")
    parser.add_argument("--texture", help="an image with the colours of the Mitsuba model")
    parser.add_argument("--camera")
    parser.add_argument("--size", default="512x288")
    parser.add_argument("--samples", type=int, default=64, help="of a picture; Mitsuba's sampler wants a square number")
    parser.add_argument("--bounces", type=int, default=2)
    parser.add_argument("--compare", default="light,time")
    parser.add_argument("--pictures", type=int, default=8, help="independent pictures of each renderer, to compare light")
    parser.add_argument("--part", type=float, default=0.01,
                        help="the part of Mitsuba's distance from surfaces at which its rays start, to compare light")
    parser.add_argument("--rounds", type=int, default=4, help="pictures of each renderer, to compare times")
    parser.add_argument("--variants", default="scalar_rgb,llvm_ad_rgb", help="Mitsuba's variants whose times are compared")
    parser.add_argument("--roulette", type=int, default=1000, help="Mitsuba's rr_depth, to compare times")
    parser.add_argument("--points", help="a CSV file to write")
    parser.add_argument("--raywall", default="target/release/examples/path_light")
    parser.add_argument("--folder", default="target", help="for files between the programs")
    args = parser.parse_args()
    if min(args.pictures, args.rounds) < 2:
        parser.error("the error of one picture alone is unknown: give --pictures and --rounds of at least 2")

    raywall, kinds = Raywall(args), args.compare.split(",")
    as_chance = compare_light(args, raywall) if "light" in kinds else True
    if "time" in kinds:
        compare_times(args, raywall)
    sys.exit(0 if as_chance else 1)


if __name__ == "__main__":
    main()
