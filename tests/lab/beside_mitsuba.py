"""Compares path-traced pictures with those of Mitsuba 3, at equal light: the same triangles, camera, sun, sky and albedo.

    make mitsuba MODEL=dragon.ply MITSUBA_OPTIONS="--camera dragon.full.toml"

Mitsuba is by other people and shares no code with Raywall. For blocks of 64x64 pixels it prints the difference of the means
in standard errors, which come from independent pictures of each renderer; and the CPU time that each needs, on one thread, to
the same error. It ends with status 1 if more blocks differ than chance allows. --points writes Mitsuba's CPU time and error with
1, 4, 16 ... samples as CSV, which `lab chart --charts light --points FILE` draws beside Raywall's.
"""

import argparse
import csv
import json
import subprocess
import sys
import time

import numpy as np

BLOCK = 64


def raywall(args, first, samples):
    """The light of a picture, top row first, and its description."""
    out = f"{args.folder}/raywall-{first}.json"
    command = [args.raywall, "--model", args.model, "--crease", "0", "--rays", "path", "--threads", "1", "--size", args.size]
    command += ["--bounces", str(args.bounces), "--first", str(first), "--samples", str(samples), "--out", out]
    command += ["--camera", args.camera] if args.camera else []
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    scene = json.load(open(out))
    pixels = np.fromfile(out.replace(".json", ".f32"), "<f4").reshape(scene["height"], scene["width"], 3)
    return pixels[::-1].astype(float), scene


def sky_map(mi, scene, height=512):
    """The sky as a picture of all directions, in Mitsuba's coordinates: y points up."""
    # The first and the last row are the poles.
    elevation = np.cos(np.linspace(0, np.pi, height))[:, None, None]
    part = 0.5 + 0.5 * elevation
    ground, zenith = np.array(scene["ground"]), np.array(scene["zenith"])
    rows = ground + (zenith - ground) * part
    return mi.Bitmap(np.repeat(rows, 2 * height, axis=1).astype(np.float32))


def mitsuba_scene(mi, args, scene):
    """The same scene for Mitsuba."""
    transform = mi.ScalarTransform4f
    # Rays start beside their surfaces by a ten-thousandth of (1 + their coordinates): on a large model that matters least.
    corners = np.array(mi.load_dict({"type": "ply", "filename": args.model}).bbox().max)
    scale = 1e3 / np.abs(corners).max()
    eye, ll, u, v = (scale * np.array(scene[name]) for name in ("eye", "ll", "u", "v"))
    middle = ll + (u + v) / 2
    distance = np.linalg.norm(middle - eye)
    aspect = np.linalg.norm(u) / np.linalg.norm(v)
    if abs(aspect * scene["height"] / scene["width"] - 1) > 1e-3 or abs((middle - eye) @ u) + abs((middle - eye) @ v) > 1e-6 * scale**2:
        sys.exit(f"Mitsuba's pixels are square, and the eye is before the middle: --size must be as wide as {aspect:.4f} heights")
    to_sun, up = np.array(scene["to_sun"]), np.array(scene["up"])
    model = {"type": "ply", "filename": args.model, "face_normals": True, "to_world": transform().scale(float(scale))}
    shape = mi.load_dict(model)
    low, high = np.array(shape.bbox().min).ravel(), np.array(shape.bbox().max).ravel()
    centre, far = (low + high) / 2, 3e3 * np.linalg.norm(high - low)
    sine = np.sin(np.radians(scene["sun_degrees"] / 2))
    # A white surface that faces the sun scatters as much as its light.
    radiance = np.array(scene["sun"]) / sine**2
    sun = transform().look_at(origin=list(centre + to_sun * far), target=list(centre), up=list(perpendicular(to_sun)))
    side = perpendicular(up)
    turned = np.eye(4)
    turned[:3, 0], turned[:3, 1], turned[:3, 2] = np.cross(up, side), up, side
    albedo = {"type": "rgb", "value": scene["albedo"]}
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": "path", "max_depth": scene["bounces"] + 2, "rr_depth": args.roulette, "hide_emitters": True},
        "sensor": {
            "type": "perspective",
            "to_world": transform().look_at(origin=list(eye), target=list(middle), up=list(v)),
            "fov": float(np.degrees(2 * np.arctan(np.linalg.norm(u) / 2 / distance))), "fov_axis": "x",
            "near_clip": 1e-3 * float(distance), "far_clip": 1e3 * float(distance),
            "film": {"type": "hdrfilm", "width": scene["width"], "height": scene["height"], "rfilter": {"type": "box"},
                     "component_format": "float32"},
            "sampler": {"type": "multijitter", "sample_count": args.samples},
        },
        "sky": {"type": "envmap", "bitmap": sky_map(mi, scene), "to_world": transform(turned)},
        "sun": {
            "type": "disk",
            "to_world": sun @ transform().scale(float(far * sine / np.sqrt(1 - sine**2))),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(map(float, radiance))}},
        },
        "model": {
            **model,
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": albedo}},
        },
    })


def perpendicular(vector):
    """A unit vector across another."""
    axis = np.eye(3)[np.argmin(np.abs(vector))]
    across = np.cross(vector, axis)
    return across / np.linalg.norm(across)


def mitsuba(args, variant, scene, counts):
    """For each number of samples, independent pictures of a variant of Mitsuba, and the mean CPU time of one."""
    import mitsuba as mi

    mi.set_variant(variant)
    import drjit as dr

    dr.set_thread_count(1)
    loaded = mitsuba_scene(mi, args, scene)
    for count in counts:
        # The first picture compiles kernels.
        np.array(mi.render(loaded, seed=99, spp=count))
        start = time.process_time()
        pictures = [np.array(mi.render(loaded, seed=seed, spp=count)).astype(float)[:, :, :3] for seed in range(args.pictures)]
        yield pictures, (time.process_time() - start) / args.pictures


def blocks(picture):
    """The means of blocks."""
    height, width = (size // BLOCK * BLOCK for size in picture.shape[:2])
    shape = (height // BLOCK, BLOCK, width // BLOCK, BLOCK, 3)
    return picture[:height, :width].reshape(shape).mean(axis=(1, 3))


def variance(pictures):
    """The variance of the mean of independent pictures, in each pixel."""
    return np.var(pictures, axis=0, ddof=1) / len(pictures)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--camera")
    parser.add_argument("--size", default="512x288")
    parser.add_argument("--samples", type=int, default=256)
    parser.add_argument("--pictures", type=int, default=4, help="independent pictures of each renderer")
    parser.add_argument("--bounces", type=int, default=2)
    parser.add_argument("--roulette", type=int, default=1000, help="Mitsuba's rr_depth")
    parser.add_argument("--variants", default="scalar_rgb,llvm_ad_rgb")
    parser.add_argument("--raywall", default="target/release/examples/path_light")
    parser.add_argument("--folder", default="target")
    parser.add_argument("--points", help="a CSV file to write")
    args = parser.parse_args()

    ours, times = [], []
    for first in (number << 20 for number in range(1, args.pictures + 1)):
        picture, scene = raywall(args, first, args.samples)
        ours.append(picture)
        times.append(scene["cpu_s"])
    of_ours, cpu_s = variance(ours), np.mean(times)
    mean = np.mean(ours, axis=0)
    lit = mean.max(axis=2) > 0

    def error_of(variances):
        """The error of one picture over the pixels that show the model."""
        return np.sqrt(args.pictures * variances[lit].mean())

    rmse = error_of(of_ours)
    print(f"raywall: {args.samples} samples a pixel, {cpu_s:.2f} s of CPU time, error {rmse:.5f}")

    # Powers of four make as many strata across as down. The last number is compared.
    counts = [4**n for n in range(16) if 4**n < args.samples] if args.points else []
    counts.append(args.samples)
    points = []
    fails = False
    for variant in args.variants.split(","):
        for count, (theirs, their_cpu_s) in zip(counts, mitsuba(args, variant, scene, counts)):
            of_theirs = variance(theirs)
            their_rmse = error_of(of_theirs)
            points.append((f"Mitsuba {variant}", count, 1e3 * their_cpu_s, their_rmse))
        difference = blocks(mean) - blocks(np.mean(theirs, axis=0))
        error = np.sqrt(blocks(of_ours + of_theirs)) / BLOCK
        seen = error > 1e-7
        deviation = np.abs(difference[seen] / error[seen])
        ratio = (cpu_s * rmse**2) / (their_cpu_s * their_rmse**2)
        relative = np.abs(difference[seen]) / blocks(mean)[seen]
        print(f"{variant}: {their_cpu_s:.2f} s of CPU time, error {their_rmse:.5f}; "
              f"to the same error raywall takes {ratio:.2f} of its CPU time")
        print(f"  {seen.sum()} means of blocks and channels: {(deviation <= 3).sum()} within 3 standard errors, "
              f"largest {deviation.max():.2f}; largest difference {100 * relative.max():.3f} % of the block's light")
        # By chance 0.27 % lie beyond three.
        fails |= bool((deviation > 3).sum() > max(1, 0.01 * seen.sum()))
    if args.points:
        with open(args.points, "w", newline="") as file:
            csv.writer(file).writerows([("name", "samples", "cpu_ms", "light_rmse"), *points])
    sys.exit(1 if fails else 0)


if __name__ == "__main__":
    main()
