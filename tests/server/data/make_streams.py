"""Writes streams.jsonl: the numbers that NumPy draws from the streams of src/env/seeding.rs.

Run: python3 make_streams.py

Numbers are hexadecimal: `words` are the raw 64 bits, `units` the bits of the doubles in [0, 1).
"""

import json
import pathlib
import struct

import numpy

MAX = 2**64 - 1
DRAWS = 11  # across two ends of four-word blocks
SEEDS = [0, 1, 42, 2**32, 2**63, MAX]
ENVIRONMENTS = [0, 1, 2**32 - 1, MAX]
INDICES = [0, 1, 999, 2**32, 2**63, MAX]


def generator(seed, environment, purpose, index):
    key = numpy.array([seed, environment], dtype=numpy.uint64)
    counter = numpy.array([0, index, purpose, 0], dtype=numpy.uint64)
    return numpy.random.Philox(key=key, counter=counter)


with open(pathlib.Path(__file__).with_name("streams.jsonl"), "w") as file:
    for seed in SEEDS:
        for environment in ENVIRONMENTS:
            for purpose in (0, 1):
                for index in INDICES:
                    address = seed, environment, purpose, index
                    words = generator(*address).random_raw(DRAWS)
                    units = numpy.random.Generator(generator(*address)).random(DRAWS)
                    row = {
                        "seed": f"{seed:x}",
                        "environment": f"{environment:x}",
                        "purpose": purpose,
                        "index": f"{index:x}",
                        "words": [f"{int(w):016x}" for w in words],
                        "units": [struct.pack(">d", u).hex() for u in units],
                    }
                    file.write(json.dumps(row) + "\n")
