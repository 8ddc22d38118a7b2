"""Hard scenes and conditions that a method is run through: what each does, and what came of it."""
