"""Editing of Gaussians: crops, removal, placement, merging, and recipes of such steps.

    from nerfloom import edit

    edited = edit.Edited.of(nerfloom.load("outputs/fox/gaussian-splatting/TIME"))
    edited = edit.drop_floaters(edit.crop_sphere(edited, (0, 0, 0), 2.0))
    edited.write("clean.spz")

Each step takes an `Edited` and returns another one. `ns-edit` takes the same steps, by the same names. Exports keep the
inside of a `Box`, a `Sphere`, or a `Polygon` on a view.
"""

from __future__ import annotations

from nerfloom.edit.contents import merge as merge
from nerfloom.edit.contents import reduce_to as reduce_to
from nerfloom.edit.contents import set_degree as set_degree
from nerfloom.edit.crop import crop_box as crop_box
from nerfloom.edit.crop import crop_mask as crop_mask
from nerfloom.edit.crop import crop_polygon as crop_polygon
from nerfloom.edit.crop import crop_region as crop_region
from nerfloom.edit.crop import crop_sphere as crop_sphere
from nerfloom.edit.drop import drop_faint as drop_faint
from nerfloom.edit.drop import drop_floaters as drop_floaters
from nerfloom.edit.drop import drop_isolated as drop_isolated
from nerfloom.edit.drop import drop_large as drop_large
from nerfloom.edit.drop import drop_needles as drop_needles
from nerfloom.edit.edited import Edited as Edited
from nerfloom.edit.held_out import HeldOut as HeldOut
from nerfloom.edit.place import align_floor as align_floor
from nerfloom.edit.place import align_points as align_points
from nerfloom.edit.place import move as move
from nerfloom.edit.place import rotate as rotate
from nerfloom.edit.place import scale as scale
from nerfloom.edit.place import set_up as set_up
from nerfloom.edit.recipe import Step as Step
from nerfloom.edit.recipe import read_recipe as read_recipe
from nerfloom.edit.recipe import write_recipe as write_recipe
from nerfloom.edit.taking import take_steps as take_steps
from nerfloom.geometry.regions import Box as Box
from nerfloom.geometry.regions import Polygon as Polygon
from nerfloom.geometry.regions import Sphere as Sphere
from nerfloom.geometry.regions import read_regions as read_regions
from nerfloom.geometry.regions import write_regions as write_regions
