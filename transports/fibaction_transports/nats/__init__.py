"""`nats://`: a fleet of workers behind brokers of NATS."""

from fibaction_transports.nats.nats_transport import NatsTransport as NatsTransport
