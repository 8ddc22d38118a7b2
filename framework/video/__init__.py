"""Pictures and videos of a run or a file along a path, for `ns-render` and `run.render_path`."""
