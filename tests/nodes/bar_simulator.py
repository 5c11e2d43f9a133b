"""The node ``simulator`` with the second engine: `python -m tests.nodes.bar_simulator`."""

import sys

from derail_ros import models
from derail_ros.nodes.simulator import main
from derail_ros.vocabulary.ledger import ENERGY_ENTRIES
from derail_ros.vocabulary.measures import MEASURES
from tests.second_engine import ENTRY, MEASURE, BarEngine

if __name__ == "__main__":
    models.register(BarEngine())
    MEASURES[MEASURE.key] = MEASURE
    ENERGY_ENTRIES[ENTRY.key] = ENTRY
    sys.exit(main())
