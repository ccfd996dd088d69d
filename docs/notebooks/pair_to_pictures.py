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
# # From a pair of frames to pictures
#
# This notebook computes a soup of planes with rigid motions from two images, two cameras and a
# flow, and then depth maps of both frames.
# `jupytext --to ipynb docs/notebooks/pair_to_pictures.py` converts this file to a notebook; it also
# runs as a plain script.

# %%
import matplotlib.pyplot as plt
import numpy as np

import soup_nlp

# %% [markdown]
# ## A pair
#
# The example is a small rendered street on which two cars move, with its exact flow. For your own
# images, create a `Pair(image_ref, image_next, K_ref, K_next)`; if it has no flow, OpenCV DIS
# computes one.

# %%
settings = {
    "input": {"kind": "scene", "scene": "street", "seed": 0, "width": 256, "height": 112},
    "flow": {"source": "truth"},
    "segmentation": {"superpixels": 50},
    "refine": {"rounds": 2},
}
problem = soup_nlp.make_problem(settings)

# %% [markdown]
# ## Solve
#
# `soup_nlp.run` builds superpixels and graphs, computes the initialisation, and then runs the
# presolve, Ipopt on the constrained NLP, and the refinement.

# %%
run = soup_nlp.run(problem, log=print)

# %%
for stage in run.solution.stages:
    print(f"{stage.name:<16} {stage.iterations:>3} iterations  {stage.status}")
print("converged:", run.solution.converged)
print("residuals:", {kind: f"{value:.1e}" for kind, value in run.residuals.items()})

# %% [markdown]
# ## The soup
#
# The soup is the state that every stage takes and returns. It holds the scale, normal, offset,
# rotation and translation of every superpixel.

# %%
soup = run.soup
print(soup)
print("sum of the scales:", soup.lam.sum())
print("energy by term:", {term: round(value, 3) for term, value in run.energy.items()})

# %% [markdown]
# ## Pictures
#
# Depth is in the unit of the soup. `run.metrics` compares it with the true depth after scaling by
# the median ratio.

# %%
score = run.metrics["solution"]
dense = run.reconstruction
truth = run.pair.truth.depth_ref
figure, axes = plt.subplots(2, 3, figsize=(12, 5))
low, high = np.nanquantile(truth, [0.02, 0.98])
shown = [
    ("reference frame", run.pair.image_ref, {}),
    ("next frame", run.pair.image_next, {}),
    ("superpixels", run.segmentation.labels % 20, {"cmap": "tab20"}),
    ("true depth", truth, {"vmin": low, "vmax": high}),
    ("depth", score.scale * dense.depth_ref, {"vmin": low, "vmax": high}),
    ("depth of the next frame", score.scale * dense.depth_next, {"vmin": low, "vmax": high}),
]
for axis, (title, image, options) in zip(axes.flat, shown):
    axis.imshow(image, **options)
    axis.set_title(title)
    axis.axis("off")
figure.tight_layout()
plt.show()

# %%
for name, metrics in run.metrics.items():
    print(f"{name:<14} {metrics}")
