"""Writes a globe with hills and a texture, for comparisons of path-traced light: as GLB, as PLY and its texture as PNG.

    target/mitsuba/bin/python tests/lab/textured_globe.py globe [fine]

This writes globe.glb, globe.ply and globe.png. The PLY file holds the same triangles and texture coordinates; Mitsuba reads no
GLB. Hills make light bounce from one place of the texture to others. Its patches are large; with `fine` the texture has four
times as many texels along each side, and random squares of 8 and 64 of them.
"""

import json
import struct
import sys
import zlib

import numpy as np

ROWS, COLUMNS = 256, 512
TEXTURE_HEIGHT = 512
FINE_TEXTURE_HEIGHT = 2048


def globe():
    """Points and texture coordinates of a grid of (ROWS + 1) x (COLUMNS + 1) vertices, and triangles as vertex numbers."""
    v, u = np.meshgrid(np.linspace(0, 1, ROWS + 1), np.linspace(0, 1, COLUMNS + 1), indexing="ij")
    polar, azimuth = np.pi * v, 2 * np.pi * u
    # Hills and valleys; none at the poles, and equal at both ends of a row.
    radius = 1 + 0.25 * np.sin(polar) ** 2 * np.sin(5 * azimuth) * np.sin(6 * polar)
    # Rotations by whole turns end where they begin.
    sine, cosine = np.sin(azimuth), np.cos(azimuth)
    sine[:, -1], cosine[:, -1] = sine[:, 0], cosine[:, 0]
    directions = np.stack([np.sin(polar) * sine, np.cos(polar), np.sin(polar) * cosine], axis=-1)
    points = (radius[..., None] * directions).reshape(-1, 3).astype("<f4")
    first = (np.arange(ROWS)[:, None] * (COLUMNS + 1) + np.arange(COLUMNS)).ravel()
    below = first + COLUMNS + 1
    upper, lower = np.stack([first, below, first + 1], axis=1), np.stack([first + 1, below, below + 1], axis=1)
    # A pole is one point: the triangles with two corners there have no area.
    triangles = np.concatenate([upper[COLUMNS:], lower[:-COLUMNS]])
    return points, np.stack([u, v], axis=-1).reshape(-1, 2).astype("<f4"), triangles.astype("<u4")


def texture():
    """8-bit sRGB, top row first: a few waves of colour, even at both poles and at the edge where left meets right."""
    height, width = TEXTURE_HEIGHT, 2 * TEXTURE_HEIGHT
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    fade = np.sin(np.pi * v) ** 2
    waves = np.stack([np.sin(2 * np.pi * (n * u + m * v)) for n, m in ((1, 0.5), (1, -1), (2, 0.5))], axis=-1)
    return np.rint(150 + 100 * fade[..., None] * waves).astype(np.uint8)


def fine_texture():
    """8-bit sRGB, top row first: colours of random squares, small ones on large ones."""
    height, width = FINE_TEXTURE_HEIGHT, 2 * FINE_TEXTURE_HEIGHT
    random = np.random.default_rng(1)

    def squares(side):
        return np.kron(random.random((height // side, width // side, 3)) - 0.5, np.ones((side, side, 1)))

    return np.rint(140 + 100 * squares(8) + 100 * squares(64)).astype(np.uint8)


def png(pixels):
    """The bytes of a PNG file."""
    height, width, _ = pixels.shape

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = b"".join(b"\0" + row.tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def glb(points, coordinates, triangles, image):
    """The bytes of a GLB file: a matte material with a texture, and no normals, so that triangles are flat."""
    parts = [points.tobytes(), coordinates.tobytes(), triangles.tobytes(), image]
    views, data = [], b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(part)})
        data += part + b"\0" * (-len(part) % 4)
    bounds = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    scene = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 1}}],
        "textures": [{"source": 0, "sampler": 0}], "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "samplers": [{"wrapS": 10497, "wrapT": 33071}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3", **bounds},
            {"bufferView": 1, "componentType": 5126, "count": len(coordinates), "type": "VEC2"},
            {"bufferView": 2, "componentType": 5125, "count": triangles.size, "type": "SCALAR"},
        ],
        "bufferViews": views, "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def ply(points, coordinates, triangles):
    """The bytes of a PLY file."""
    properties = "".join(f"property float {name}\n" for name in "xyzuv")
    header = (f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{properties}"
              f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n")
    faces = np.empty(len(triangles), dtype=[("n", "u1"), ("corners", "<i4", 3)])
    faces["n"], faces["corners"] = 3, triangles
    return header.encode() + np.hstack([points, coordinates]).tobytes() + faces.tobytes()


def main():
    if len(sys.argv) < 2 or sys.argv[2:] not in ([], ["fine"]):
        sys.exit("give the files' name without an ending, and fine for a fine texture: textured_globe.py globe [fine]")
    name, is_fine = sys.argv[1], len(sys.argv) == 3
    points, coordinates, triangles = globe()
    image = png(fine_texture() if is_fine else texture())
    files = {"glb": glb(points, coordinates, triangles, image), "ply": ply(points, coordinates, triangles), "png": image}
    for ending, data in files.items():
        with open(f"{name}.{ending}", "wb") as file:
            file.write(data)


if __name__ == "__main__":
    main()
