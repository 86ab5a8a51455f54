"""Reads and writes MPCDI files with Python's standard library alone: no code of the wall's.

    mpcdi.py read FILE FOLDER   unpacks, and prints each region: id, columns, rows, x, y, width, height, then the warp's
                                values at nine pixels of it: column, row, u, v
    mpcdi.py write FILE         writes two regions of 320 x 240 pixels, whose warps have 41 x 31 points
"""

import math
import struct
import sys
import xml.etree.ElementTree as tree
import zipfile


def read(path, folder):
    archive = zipfile.ZipFile(path)
    assert archive.testzip() is None
    archive.extractall(folder)
    root = tree.fromstring(archive.read("mpcdi.xml"))
    assert root.tag == "MPCDI" and root.get("profile") == "2d" and root.get("version") == "2.0"
    files = {fileset.get("region"): fileset for fileset in root.find("files")}
    for region in root.find("display").find("buffer"):
        warp = files[region.get("id")].find("geometryWarpFile")
        assert warp.find("interpolation").text == "linear" and warp.find("geometricUnit").text == "2D"
        kind, size, scale, body = archive.read(warp.find("path").text).split(b"\n", 3)
        columns, rows = map(int, size.split())
        assert kind == b"PF" and float(scale) < 0 and len(body) == 12 * columns * rows
        assert [columns, rows] == [int(region.get("Xresolution")), int(region.get("Yresolution"))]
        place = [region.get(name) for name in ("x", "y", "xsize", "ysize")]
        values = []
        for row in (0, rows // 3, rows - 1):
            for column in (0, columns // 2, columns - 1):
                # Rows are stored from the bottom up.
                u, v, _ = struct.unpack_from("<fff", body, 12 * ((rows - 1 - row) * columns + column))
                values += [column, row, u, v]
        print(region.get("id"), columns, rows, *place, *values, sep="\t")


def write(path):
    """Two regions side by side that share a fifth; lines of the picture are arcs on the projectors."""
    xml = '<?xml version="1.0"?><MPCDI profile="2d" geometry="1" level="1" date="2015-01-01" version="2.0"><display>'
    xml += '<buffer id="b" Xresolution="2000" Yresolution="1000">'
    regions = [("left", 0.0), ("right", 0.4)]
    for name, x in regions:
        xml += f'<region id="{name}" Xresolution="320" Yresolution="240" x="{x}" y="0" xSize="0.6" ySize="1"/>'
    xml += "</buffer></display><files>"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, _ in regions:
            xml += f'<fileset region="{name}"><geometryWarpFile><path>warps/{name}.pfm</path>'
            xml += "<interpolation>linear</interpolation></geometryWarpFile></fileset>"
            body = b""
            for row in reversed(range(31)):
                for column in range(41):
                    x, y = column / 40, row / 30
                    u = 0.05 + 0.9 * x
                    v = 0.1 + 0.8 * y + 0.05 * math.sin(math.pi * x)
                    # Big endian.
                    body += struct.pack(">fff", u, v, 0.0)
            archive.writestr(f"warps/{name}.pfm", b"PF\n41 31\n1.0\n" + body)
        archive.writestr("mpcdi.xml", xml + "</files></MPCDI>")


if __name__ == "__main__":
    {"read": read, "write": write}[sys.argv[1]](*sys.argv[2:])
