"""``python -m infgen.sources.argoverse2``: what ``TableProcess`` starts."""

import sys

from infgen.sources.argoverse2.table_process import serve
from infgen.sources.argoverse2.tables import read_table

if __name__ == "__main__":
    serve(read_table, sys.stdin.buffer, sys.stdout.buffer)
