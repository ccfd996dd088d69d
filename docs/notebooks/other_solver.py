# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From the .nl file to another solver to depth
#
# `soup-nlp export` writes the constrained NLP to a file that any AMPL solver can read. This
# notebook solves the NLP from that file alone. It uses POUNCE if it is installed; otherwise CasADi
# reads the .nl file and its Ipopt solves it. The answer is a .sol file, and `soup-nlp import` turns
# it into a result folder with depth maps.

# %%
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt

import soup_nlp
from soup_nlp.cli.main import main

folder = Path(tempfile.mkdtemp())

# %% [markdown]
# ## Export
#
# This cell does the same as `soup-nlp export orbit.yaml -o orbit --presolve`. The starting point in
# the file is the presolve's answer, as for Ipopt in `soup-nlp solve`, so that a solver confirms it
# in a few iterations. Without `--presolve` it is the initialisation.

# %%
(folder / "orbit.yaml").write_text(
    """
input: {kind: scene, scene: orbit, width: 160, height: 80}
flow: {source: truth}
segmentation: {superpixels: 12, neighbours: 4}
energy: {pixel_samples: 4}
"""
)
exported = folder / "orbit"
code = main(["export", str(folder / "orbit.yaml"), "-o", str(exported), "--presolve"])
assert code == 0
print(sorted(path.name for path in exported.iterdir()))

# %% [markdown]
# ## Solve with another solver
#
# A program that follows the AMPL convention writes `soup.sol` next to `soup.nl`. The options tell
# the interior-point solver that the starting point is already close to the solution.

# %%
options = {"mu_init": 1e-5, "bound_push": 1e-6, "bound_frac": 1e-6, "nlp_scaling_method": "none"}
pounce = shutil.which("pounce") or shutil.which(str(Path(sys.executable).parent / "pounce"))


def solve_by_program(program: str) -> None:
    """Run a solver on the .nl file."""
    words = [program, "soup.nl", *(f"{name}={value}" for name, value in options.items())]
    subprocess.run(words, cwd=exported, check=True, stdout=subprocess.DEVNULL)


def solve_by_casadi() -> None:
    """Read the .nl file with CasADi, solve it with Ipopt, write the .sol file."""
    import numpy as np

    builder = ca.NlpBuilder()
    builder.import_nl(str(exported / "soup.nl"), {})
    x, g = ca.vertcat(*builder.x), ca.densify(ca.vertcat(*builder.g))
    plain = ca.Function("nl", [x], [builder.f, g]).expand()
    s = ca.SX.sym("x", x.numel())
    f, g = plain(s)
    quiet = {"ipopt": {**options, "print_level": 0, "sb": "yes"}, "print_time": False}
    solver = ca.nlpsol("solver", "ipopt", {"x": s, "f": f, "g": g}, quiet)
    answer = solver(
        x0=builder.x_init, lbx=builder.x_lb, ubx=builder.x_ub, lbg=builder.g_lb, ubg=builder.g_ub
    )
    status = solver.stats()["return_status"]
    # x and g are already in the order of the file; AMPL's multipliers have the opposite sign
    duals, values = -np.asarray(answer["lam_g"]).ravel(), np.asarray(answer["x"]).ravel()
    sizes = [len(duals), len(duals), len(values), len(values)]
    lines = [f"Ipopt on the imported file: {status}", "", "Options", 3, 0, 1, 0, *sizes]
    lines += [*map(repr, duals.tolist()), *map(repr, values.tolist())]
    lines += [f"objno 0 {0 if status == 'Solve_Succeeded' else 400}"]
    (exported / "soup.sol").write_text("\n".join(map(str, lines)) + "\n")


if pounce:
    solve_by_program(pounce)
else:
    solve_by_casadi()
print((exported / "soup.sol").read_text().splitlines()[0])

# %% [markdown]
# ## The same without a file
#
# `soup_nlp.nlp` gives the program as CasADi expressions. Here Ipopt solves it from the
# initialisation, in tangent coordinates, by the stages of `soup-nlp solve`: less smoothing with the
# majorant Hessian (theta = 0), whose model lies above every norm, then more of the curvature along
# each residual, at last the exact Hessian.

# %%
quiet = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False}


def solve_tangent(point, hessian, mu, **parameters):
    """Ipopt on the tangent program from a point; returns the program and the answer."""
    nlp = soup_nlp.nlp(folder / "orbit.yaml", coordinates="tangent", hessian=hessian)
    options = {"ipopt.mu_init": mu, **quiet, **nlp.derivatives}
    solver = ca.nlpsol("s", "ipopt", nlp.problem, options)
    start = nlp.start if point is None else {**nlp.start, "x0": point}
    return nlp, solver(**{**start, "p": nlp.parameters(**parameters)})


point = None
for eps, theta in ((0.3, 0), (0.03, 0), (0.01, 0), (0.01, 0.5), (0.01, 0.9), (0.01, 0.98)):
    smoothing = {"eps": eps, "eps_pixel": eps, "theta": theta, "ridge": 0.0}
    nlp, answer = solve_tangent(point, "gauss-newton", 1e-6, **smoothing)
    point = answer["x"]
nlp, answer = solve_tangent(point, "exact", 1e-8)
soup = nlp.soup(answer["x"])
print(f"smoothed energy {float(answer['f']):.6f}")

# %% [markdown]
# ## Check and import
#
# `check` lists the residuals by kind and the superpixels with the largest ones. `import` recomputes
# energy and residuals from the point and writes the same folder as `soup-nlp solve`.

# %%
assert main(["check", str(exported / "soup.sol")]) == 0

# %%
assert main(["import", str(exported), str(exported / "soup.sol")]) == 0
result = exported / "result"

# %% [markdown]
# ## Depth

# %%
figure, axis = plt.subplots(figsize=(12, 4))
axis.imshow(plt.imread(result / "overview.png"))
axis.axis("off")
figure.tight_layout()
plt.show()

# %%
print(soup_nlp.__version__, sorted(path.name for path in result.iterdir()))
