# SPDX-License-Identifier: Apache-2.0
"""Functional Mock-up Units (FMI 2.0 and 3.0): `units`, and `imported` ones that run as stages."""
