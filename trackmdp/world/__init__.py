"""The target and the sensing grid."""
