"""Pictures and videos of a run or a file along a path: what `ns-render` and `run.render_path` make."""
