"""The scene of a path-traced picture for Mitsuba 3, and an integrator whose rays start closer to surfaces than Mitsuba's."""

import numpy as np

# Mitsuba's rays start beside surfaces by a ten-thousandth of (1 + their coordinates): on a large model that matters least.
LARGEST_COORDINATE = 1e3

# In diagonals of the model. From 3,000 of them, the parts nearest to the sun got a five-thousandth too much of its light.
SUN_DISTANCE = 1e5


def load(mi, scene, model, texture=None, roulette=1000):
    """The scene that `path_light` describes, with the triangles of a PLY file and the colours of an image."""
    transform = mi.ScalarTransform4f
    bounds = mi.load_dict({"type": "ply", "filename": model, "face_normals": True}).bbox()
    scale = LARGEST_COORDINATE / np.abs([bounds.min, bounds.max]).max()
    eye, ll, u, v = (scale * np.array(scene[name]) for name in ("eye", "ll", "u", "v"))
    low, high = scale * np.array(bounds.min).ravel(), scale * np.array(bounds.max).ravel()
    middle = ll + (u + v) / 2
    distance = np.linalg.norm(middle - eye)
    aspect = np.linalg.norm(u) / np.linalg.norm(v)
    if abs(aspect * scene["height"] / scene["width"] - 1) > 1e-3 or abs((middle - eye) @ u) + abs((middle - eye) @ v) > 1e-6 * scale**2:
        raise SystemExit(f"Mitsuba's pixels are square, and the eye is before the middle: --size must be as wide as {aspect:.4f} heights")
    to_sun, up = np.array(scene["to_sun"]), np.array(scene["up"])
    centre, far = (low + high) / 2, SUN_DISTANCE * np.linalg.norm(high - low)
    sine = np.sin(np.radians(scene["sun_degrees"] / 2))
    # A white surface that faces the sun scatters as much as its light. The disc hides the sky behind it, which Raywall's does not.
    radiance = np.array(scene["sun"]) / sine**2 + sky_light(scene, to_sun @ up)
    sun = transform().look_at(origin=list(centre + to_sun * far), target=list(centre), up=list(perpendicular(to_sun)))
    side = perpendicular(up)
    turned = np.eye(4)
    turned[:3, 0], turned[:3, 1], turned[:3, 2] = np.cross(up, side), up, side
    albedo = {"type": "rgb", "value": scene["albedo"]}
    if texture:
        albedo = {"type": "bitmap", "filename": texture, "format": "variant"}
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": "path", "max_depth": scene["bounces"] + 2, "rr_depth": roulette, "hide_emitters": True},
        "sensor": {
            "type": "perspective",
            "to_world": transform().look_at(origin=list(eye), target=list(middle), up=list(v)),
            "fov": float(np.degrees(2 * np.arctan(np.linalg.norm(u) / 2 / distance))), "fov_axis": "x",
            "near_clip": 1e-3 * float(distance), "far_clip": 1e3 * float(distance),
            "film": {"type": "hdrfilm", "width": scene["width"], "height": scene["height"], "rfilter": {"type": "box"},
                     "component_format": "float32"},
            "sampler": {"type": "multijitter", "sample_count": 64},
        },
        "sky": {"type": "envmap", "bitmap": sky_map(mi, scene), "to_world": transform(turned)},
        "sun": {
            "type": "disk",
            "to_world": sun @ transform().scale(float(far * sine / np.sqrt(1 - sine**2))),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(map(float, radiance))}},
        },
        "model": {
            "type": "ply", "filename": model, "face_normals": True, "to_world": transform().scale(float(scale)),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": albedo}},
        },
    })


def sky_light(scene, cosine):
    """Linear light of the sky in directions of these cosines with the direction up."""
    ground, zenith = np.array(scene["ground"]), np.array(scene["zenith"])
    return ground + (zenith - ground) * (0.5 + 0.5 * cosine)


def sky_map(mi, scene, height=512):
    """The sky as a picture of all directions, in Mitsuba's coordinates: y points up."""
    # The first and the last row are the poles.
    rows = sky_light(scene, np.cos(np.linspace(0, np.pi, height))[:, None, None])
    return mi.Bitmap(np.repeat(rows, 2 * height, axis=1).astype(np.float32))


def perpendicular(vector):
    """A unit vector across another."""
    axis = np.eye(3)[np.argmin(np.abs(vector))]
    across = np.cross(vector, axis)
    return across / np.linalg.norm(across)


def near_paths(mi, bounces, part):
    """An integrator like Mitsuba's `path`, without roulette; its rays start at a part of the distance from surfaces.

    It works with a variant that is compiled when it runs, like llvm_ad_rgb.
    """
    import drjit as dr

    def spawn(si, direction):
        """A ray from a surface."""
        distance = part * mi.math.RayEpsilon * (1 + dr.max(dr.abs(si.p)))
        origin = dr.fma(si.n, dr.copysign(distance, dr.dot(si.n, direction)), si.p)
        return mi.Ray3f(origin, direction, si.time, si.wavelengths)

    def weight(density, other):
        """Veach's power heuristic."""
        return dr.select(density > 0, density**2 / (density**2 + other**2), 0)

    class NearPaths(mi.SamplingIntegrator):
        """Samples light and surfaces at each hit, as in Pharr, Jakob and Humphreys (2023, section 13.4)."""

        def sample(self, scene, sampler, ray, medium=None, active=True):
            context = mi.BSDFContext()
            light, throughput = mi.Spectrum(0), mi.Spectrum(1)
            si = scene.ray_intersect(ray, active)
            # The eye sees neither sun nor sky.
            active = mi.Bool(active) & si.is_valid() & (si.emitter(scene) == None)  # noqa: E711
            seen = mi.Bool(active)
            for _ in range(bounces + 1):
                bsdf = si.bsdf()
                ds, emitted = scene.sample_emitter_direction(si, sampler.next_2d(active), False, active)
                to_light = active & (ds.pdf > 0)
                shadow = spawn(si, ds.d)
                shadow.maxt = ds.dist * (1 - mi.math.ShadowEpsilon)
                to_light &= ~scene.ray_test(shadow, to_light)
                scattered, density = bsdf.eval_pdf(context, si, si.to_local(ds.d), to_light)
                light += dr.select(to_light, throughput * scattered * emitted * weight(ds.pdf, density), 0)

                sample, part_of_light = bsdf.sample(context, si, sampler.next_1d(active), sampler.next_2d(active), active)
                active &= sample.pdf > 0
                throughput *= part_of_light
                ray = spawn(si, si.to_world(sample.wo))
                next_si = scene.ray_intersect(ray, active)
                emitter = next_si.emitter(scene, active)
                lit = active & (emitter != None)  # noqa: E711
                ds = mi.DirectionSample3f(scene, next_si, si)
                of_light = scene.pdf_emitter_direction(si, ds, lit)
                emitted = emitter.eval(next_si, lit)
                light += dr.select(lit, throughput * emitted * weight(sample.pdf, of_light), 0)
                active &= next_si.is_valid() & ~lit
                si = next_si
            return light, seen, []

    return NearPaths(mi.Properties())
