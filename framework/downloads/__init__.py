"""Downloads of public data sets: where they are, fetching, unpacking, and the folders that ns-train recognises."""
