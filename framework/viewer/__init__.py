"""The viewer in a browser: what is asked for, in which order it is drawn, and the page."""
