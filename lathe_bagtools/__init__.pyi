# SPDX-License-Identifier: Apache-2.0
# The public face of lathe_bagtools, and the only list of it.

from lathe_bagtools.hosts import digests_by_host as digests_by_host
