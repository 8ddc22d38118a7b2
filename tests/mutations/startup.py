"""Imported first by interpreters that a recorded test starts: what they run counts as the test's."""

import os

import coverage

if os.environ.get("MUTATIONS_CONTEXT"):
    folder = os.environ["MUTATIONS_RECORD"]
    recording = coverage.Coverage(
        config_file=f"{folder}/coveragerc", data_suffix=True, context=os.environ["MUTATIONS_CONTEXT"], auto_data=True
    )
    recording.start()
