"""Downloads of public data sets: addresses, fetching, unpacking, and the folders that ns-train recognises."""
