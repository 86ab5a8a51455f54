"""MPCDI files of views and of points in space, by Python's standard library alone: no code of the wall's.

    mpcdi_space.py read FILE            prints each region: id, then for nine pixels column, row, and in profile 3d the ray
                                        from the eye, in a3 the point in metres; x to the right, y up, z towards the audience
    mpcdi_space.py write FILE READING   writes four views of a flat wall that overlap, with alpha maps, and prints places on the
                                        wall at nine pixels of each: column, row, x, y. READING is "standard", or "library" for
                                        the angles of the example in the standard's library, "none" for angles that fit none, or
                                        "holes" for the standard's and a pixel without numbers
    mpcdi_space.py strip FILE TARGET    writes the file again without alpha maps, and with a unit that nobody knows
"""

import math
import struct
import sys
import xml.etree.ElementTree as tree
import zipfile
import zlib


def product(a, b):
    return [[sum(a[i][k] * b[k][j] for k in range(3)) for j in range(3)] for i in range(3)]


def image(a, v):
    return [sum(a[i][k] * v[k] for k in range(3)) for i in range(3)]


def turned(axis, degrees):
    """Anticlockwise as seen from the axis's tip."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return {
        "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
        "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }[axis]


def world_from_viewer(yaw, pitch, roll, reading):
    """x to the right, y up, and the viewer looks against z."""
    if reading == "library":
        # viewer from world is glRotated(yaw, y) glRotated(pitch, x) glRotated(roll, z).
        viewer = product(product(turned("y", yaw), turned("x", pitch)), turned("z", roll))
        return [list(row) for row in zip(*viewer)]
    # To the right is clockwise from above, and a head that leans to the right turns clockwise from behind.
    return product(product(turned("y", -yaw), turned("x", pitch)), turned("z", -roll))


def tangents(edges):
    return [math.tan(math.radians(degrees)) for degrees in edges]


def read(path):
    archive = zipfile.ZipFile(path)
    root = tree.fromstring(archive.read("mpcdi.xml"))
    profile = root.get("profile")
    files = {fileset.get("region"): fileset for fileset in root.find("files")}
    for region in root.find("display").find("buffer"):
        warp = files[region.get("id")].find("geometryWarpFile")
        kind, size, scale, body = archive.read(warp.find("path").text).split(b"\n", 3)
        columns, rows = map(int, size.split())
        assert kind == b"PF" and float(scale) < 0 and len(body) == 12 * columns * rows
        assert profile == "3d" or warp.find("geometricUnit").text == "m"
        numbers = []
        for row in (0, rows // 3, rows - 1):
            for column in (0, columns // 2, columns - 1):
                r, g, b = struct.unpack_from("<fff", body, 12 * ((rows - 1 - row) * columns + column))
                if profile == "3d":
                    frustum = {part.tag: float(part.text) for part in region.find("frustum")}
                    names = ("leftAngle", "rightAngle", "upAngle", "downAngle")
                    left, right, up, down = tangents([frustum[name] for name in names])
                    ray = [left + r * (right - left), up + g * (down - up), -1]
                    turn = world_from_viewer(frustum["yaw"], frustum["pitch"], frustum["roll"], "standard")
                    point = image(turn, ray)
                else:
                    # The standard's axes: X to the left, Y up, Z ahead.
                    point = [-r, g, -b]
                numbers += [column, row, *point]
        print(region.get("id"), *numbers, sep="\t")


COLUMNS, ROWS = 80, 60
EDGES = [-17, 18, 13, -14]
# Yaw, pitch and roll of four views.
VIEWS = {
    "upper left": (-13, 9, 3),
    "upper right": (14, 8, -4),
    "lower left": (-14, -9, -5),
    "lower right": (12, -10, 6),
}


def png(values):
    raw = b"".join(b"\0" + bytes(values[row * COLUMNS : (row + 1) * COLUMNS]) for row in range(ROWS))
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    head = struct.pack(">IIBBBBB", COLUMNS, ROWS, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b"")


def write(path, reading):
    left, right, up, down = tangents(EDGES)
    turns = {name: world_from_viewer(*angles, reading) for name, angles in VIEWS.items()}

    def place(name, u, v):
        x, y, z = image(turns[name], [left + u * (right - left), up + v * (down - up), -1])
        return x / -z, y / -z

    def weight(name, x, y):
        x, y, z = image([list(row) for row in zip(*turns[name])], [x, y, -1])
        u, v = (x / -z - left) / (right - left), (y / -z - up) / (down - up)
        return max(0, min(u, 1 - u, v, 1 - v))

    xml = '<?xml version="1.0"?><MPCDI profile="3d" geometry="1" level="1" date="2015-01-01" version="2.0"><display>'
    xml += '<buffer id="b" Xresolution="2000" Yresolution="1000">'
    for name, (yaw, pitch, roll) in VIEWS.items():
        if reading == "none":
            yaw, pitch = 1.6 * yaw, pitch + 0.7 * yaw
        xml += f'<region id="{name}" xResolution="{COLUMNS}" yResolution="{ROWS}" x="0" y="0" xSize="1" ySize="1"><frustum>'
        xml += f"<yaw>{yaw}</yaw><pitch>{pitch}</pitch><roll>{roll}</roll><rightAngle>{EDGES[1]}</rightAngle>"
        xml += f"<leftAngle>{EDGES[0]}</leftAngle><upAngle>{EDGES[2]}</upAngle><downAngle>{EDGES[3]}</downAngle>"
        xml += "</frustum></region>"
    xml += "</buffer></display><files>"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in VIEWS:
            xml += f'<fileset region="{name}"><geometryWarpFile><path>{name}.pfm</path>'
            xml += f"<interpolation>linear</interpolation></geometryWarpFile><alphaMap><path>{name}.png</path>"
            xml += "<componentDepth>1</componentDepth><bitDepth>8</bitDepth><gammaEmbedded>2.2</gammaEmbedded></alphaMap>"
            xml += "</fileset>"
            body, alpha, truth = b"", [], []
            for row in range(ROWS):
                for column in range(COLUMNS):
                    u, v = (column + 0.5) / COLUMNS, (row + 0.5) / ROWS
                    x, y = place(name, u, v)
                    part = weight(name, x, y) / sum(weight(other, x, y) for other in VIEWS)
                    alpha.append(round(255 * part ** (1 / 2.2)))
                    if row in (3, 30, 55) and column in (4, 41, 70):
                        truth += [column, row, x, y]
            for row in reversed(range(ROWS)):
                for column in range(COLUMNS):
                    u = math.nan if reading == "holes" and (column, row) == (9, 7) else (column + 0.5) / COLUMNS
                    body += struct.pack("<fff", u, (row + 0.5) / ROWS, math.nan)
            archive.writestr(f"{name}.pfm", b"PF\n%d %d\n-1.0\n" % (COLUMNS, ROWS) + body)
            archive.writestr(f"{name}.png", png(alpha))
            print(name, *truth, sep="\t")
        archive.writestr("mpcdi.xml", xml + "</files></MPCDI>")


def strip(path, target):
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in source.namelist():
            content = source.read(name)
            if name == "mpcdi.xml":
                root = tree.fromstring(content)
                for parent in list(root.iter()):
                    for child in list(parent):
                        if child.tag == "alphaMap":
                            parent.remove(child)
                for unit in root.iter("geometricUnit"):
                    unit.text = "parsec"
                content = tree.tostring(root)
            archive.writestr(name, content)


if __name__ == "__main__":
    {"read": read, "write": write, "strip": strip}[sys.argv[1]](*sys.argv[2:])
