#!/bin/sh
# Headers, static libraries and the packages' own tests are of no use at run time.
set -eu
find /opt/tandem/lib -path '*/site-packages/*' -type d \( -name include -o -name tests \) -prune -exec rm -rf {} +
find /opt/tandem/lib -name '*.a' -delete
