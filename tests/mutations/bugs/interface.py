"""What somebody with a loop of their own gets: `import nerfloom`, and alphas."""

from tests.mutations.bug import Bug

BUGS = (
    Bug(
        "opaque-alpha-learns-nothing",
        "interface",
        "framework/kernels/compositing/alpha.py",
        "alpha - (alpha - alpha.clamp(max=most)).detach()",
        "alpha.clamp(max=most)",
        "a surface that has become opaque can never become transparent again",
    ),
    Bug(
        "alpha-without-distances",
        "interface",
        "framework/kernels/compositing/alpha.py",
        "t_ends=torch.ones_like(t), points=t)",
        "t_ends=torch.ones_like(t), points=None)",
        "the depth of every surface is 0.5",
    ),
    Bug(
        "functions-never-stop",
        "interface",
        "framework/plug_and_play/skipping.py",
        "stop = 0.0 if sigma_fn is None else early_stop",
        "stop = 0.0",
        "what is hidden is sampled all the same",
    ),
    Bug(
        "time-of-the-grid-alone",
        "interface",
        "framework/plug_and_play/functions.py",
        "function(*arguments) if times is None else function(*arguments, times)",
        "function(*arguments) if times is None else function(*arguments, times[:1].expand_as(times))",
        "all rays of a moving scene are coloured at the time of the first",
    ),
    Bug(
        "extras-teach-no-density",
        "interface",
        "framework/plug_and_play/rendering.py",
        "return ray_sum(weights.view(",
        "return ray_sum(weights.detach().view(",
        "a loss on depths, normals or semantics moves no density",
    ),
    Bug(
        "clipped-nearer-than-near",
        "interface",
        "framework/plug_and_play/sampling.py",
        "nears = torch.minimum(torch.maximum(enter, rays.nears), leave)",
        "nears = torch.minimum(enter, leave)",
        "rays are sampled in front of where they were said to start",
    ),
    Bug(
        "draws-by-the-weights-of-the-neighbour",
        "interface",
        "framework/plug_and_play/sampling.py",
        "inverse_cdf(edges, samples.padded(weights.detach()), u)",
        "inverse_cdf(edges, samples.padded(weights.detach()).roll(1, 1), u)",
        "further samples fall one interval behind where light is stopped",
    ),
)
