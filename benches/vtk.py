#!/usr/bin/env python3
"""Ray casting beside VTK's fixed-point mapper: one CT resampled to 256^3, one camera and transfer function, two threads, by turns in one run.

    python benches/vtk.py VTK_SCRIPT CT [--camera EYE TARGET UP FOV] [--rounds N]

VTK_SCRIPT renders one volume with VTK and prints {"median_ms": ..}; it takes VOLUME OUT.png --size --step --frames --eye --target --up --fov, and its
transfer function is transfer_ct.json beside it. Needs python with vtk, SimpleITK, numpy and pillow, and cargo. Prints what the README reports:
times over VTK's, root mean square difference of each picture from its own at a tenth of the step (where either shows something), bricks over a
nearly flat array (bricks of 128^3), and a frame's time for 128^3 to 512^3. Each time is given by the wall's clock (best) and as processor time over
two threads (mean), which other programs on the machine disturb less; compare ratios.
"""
import argparse, json, os, resource, shutil, subprocess, sys, tempfile
import numpy as np, SimpleITK as sitk
from PIL import Image

p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
p.add_argument("vtk_script"); p.add_argument("ct")
p.add_argument("--camera", nargs=4, default=["122,-400,80", "122,122,80", "0,0,1", "30"], metavar=("EYE", "TARGET", "UP", "FOV"))
p.add_argument("--size", default="1224x1014"); p.add_argument("--rounds", type=int, default=5)
p.add_argument("--step", default="1.15", help="ours, in pieces by weight [mm]"); p.add_argument("--vtk-step", default="1.0")
p.add_argument("--iso", default="276", help="of the surface [HU]")
a = p.parse_args()
root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
transfer = os.path.join(os.path.dirname(os.path.abspath(a.vtk_script)), "transfer_ct.json")
work = tempfile.TemporaryDirectory(prefix="maille-vtk-")
at = lambda name: os.path.join(work.name, name)


def resample(edge):
    """The CT in edge^3 voxels of the same box."""
    image, path = sitk.ReadImage(a.ct), at(f"{edge}.nrrd")
    extent = [(n - 1) * s for n, s in zip(image.GetSize(), image.GetSpacing())]
    size, spacing = [edge] * 3, [e / (edge - 1) for e in extent]
    sitk.WriteImage(sitk.Resample(image, size, sitk.Transform(), sitk.sitkLinear, image.GetOrigin(), spacing, image.GetDirection()), path)
    return path


def build(edge):
    """The program with bricks of this edge; none: the project's own."""
    env = dict(os.environ)
    env.pop("MAILLE_BRICK_EDGE", None)
    if edge:
        env["MAILLE_BRICK_EDGE"] = str(edge)
    subprocess.run(["cargo", "build", "--release", "-q", "-p", "maille-raycast", "--example", "frames"], cwd=root, env=env, check=True)
    target = os.environ.get("CARGO_TARGET_DIR", os.path.join(root, "target"))
    return shutil.copy(os.path.join(target, "release", "examples", "frames"), at(f"frames{edge or ''}"))


class Ours:
    def __init__(self, program, volume):
        eye, target, up, fov = a.camera
        self.process = subprocess.Popen([program, volume, a.size, eye, target, up, fov, transfer], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __call__(self, request):
        self.process.stdin.write(request + "\n"); self.process.stdin.flush()
        return json.loads(self.process.stdout.readline()).get("ms")

    def timed(self, request):
        """Wall times of the frames, and processor time of one over two threads [ms], the map of empty space being there already."""
        self(request.rsplit(" ", 1)[0] + " 1")
        before = self.processor_ms()
        walls = self(request)
        return walls, (self.processor_ms() - before) / (2 * len(walls))

    def processor_ms(self):
        with open(f"/proc/{self.process.pid}/stat") as f:
            words = f.read().rsplit(")", 1)[1].split()
        return (int(words[11]) + int(words[12])) * 1e3 / os.sysconf("SC_CLK_TCK")

    def picture(self, request):
        self(request); self("picture " + at("ours.ppm"))
        return np.asarray(Image.open(at("ours.ppm")).convert("RGB")).astype(float)


def vtk(volume, step, frames):
    eye, target, up, fov = a.camera
    options = [f"--size={a.size}", f"--step={step}", f"--frames={frames}", f"--eye={eye}", f"--target={target}", f"--up={up}", f"--fov={fov}"]
    out = subprocess.run([sys.executable, a.vtk_script, volume, at("vtk.png"), *options], check=True, capture_output=True, text=True).stdout
    return json.loads(out.strip().splitlines()[-1])["median_ms"], np.asarray(Image.open(at("vtk.png")).convert("RGB")).astype(float)


def rms(picture, reference, inside):
    return float(np.sqrt(((picture - reference)[inside] ** 2).mean()))


def vtk_timed(volume):
    """Wall and processor time of a frame [ms]: what five frames more take."""
    spent = lambda: sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2]) * 1e3
    marks, walls = [spent()], []
    for frames in (2, 7):
        walls.append(vtk(volume, a.vtk_step, frames)[0]); marks.append(spent())
    return walls, (marks[2] - 2 * marks[1] + marks[0]) / (2 * 5)


programs = {edge: build(edge) for edge in (128, None)}
volume = resample(256)
bricks, flat = Ours(programs[None], volume), Ours(programs[128], volume)
requests = {"by weight": f"volume {a.step} 5", "even": "even 0.9 5", "surface": f"surface {a.iso} 1.0 10"}
walls, spent = {}, {}


def note(name, result):
    walls.setdefault(name, []).extend(result[0]); spent.setdefault(name, []).append(result[1])


for _ in range(a.rounds):
    for name, request in requests.items():
        note(name, bricks.timed(request))
    for name in ("by weight", "surface"):
        note("flat, " + name, flat.timed(requests[name]))
    note("vtk", vtk_timed(volume))
best, mean = {n: min(t) for n, t in walls.items()}, {n: sum(t) / len(t) for n, t in spent.items()}
fine_ours, fine_vtk = bricks.picture("even 0.1 1"), vtk(volume, 0.1, 1)[1]
inside = (fine_ours.max(axis=2) > 0) | (fine_vtk.max(axis=2) > 0)
off = {"by weight": rms(bricks.picture(f"volume {a.step} 1"), fine_ours, inside), "even": rms(bricks.picture("even 0.9 1"), fine_ours, inside)}
off["vtk"] = rms(vtk(volume, a.vtk_step, 1)[1], fine_vtk, inside)
print(f"load {os.getloadavg()[0]:.1f}; {inside.mean():.2f} of the picture shows something")
for name in walls:
    error = f"; RMS against its own step 0.1: {off[name]:.2f}/255" if name in off else ""
    print(f"{name:>15}: wall {best[name]:6.1f} ms, processor {mean[name]:6.1f} ms; VTK over it {best['vtk'] / best[name]:5.2f} and {mean['vtk'] / mean[name]:5.2f}{error}")
for name in ("by weight", "surface"):
    print(f"bricks over flat, {name}: {best[name] / best['flat, ' + name]:.3f} and {mean[name] / mean['flat, ' + name]:.3f}")
flat.process.terminate()
for edge in (128, 256, 512):
    ours = bricks if edge == 256 else Ours(programs[None], resample(edge))
    (w, p), (sw, sp) = ours.timed(requests["by weight"]), ours.timed(requests["surface"])
    print(f"{edge}^3: by weight {min(w):.1f} and {p:.1f} ms, surface {min(sw):.1f} and {sp:.1f} ms")
    if edge == 256:
        print(f"64 bricks changed: the map of empty space follows in {min(ours(f'commit {a.step} 20')):.2f} ms (wall, best)")
    ours.process.terminate()
