"""A node whose files cannot grow: `python -m tests.nodes.small_disk recorder 200000 ...`."""

import resource
import sys

from derail_ros.nodes.process import run_node

if __name__ == "__main__":
    node, size, *arguments = sys.argv[1:]
    # Python ignores the signal: writing fails with an error, as on a full disk.
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(size), int(size)))
    sys.exit(run_node(node, arguments))
