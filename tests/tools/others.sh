#!/bin/sh
# Try the programs of others: `others.sh openapi | agents | frontends`. They are in environments of
# their own, since the tests of the project must pass without what they bring.
set -e
try() { .venv/bin/python -m pytest -q "$@"; }
case $1 in
openapi)
    tests/tools/venv.sh .venv-openapi --group openapi
    FIBACTION_OPENAPI=required try tests/transports/web/test_openapi_clients.py
    ;;
agents)
    tests/tools/venv.sh .venv-mcp-agents --group mcp-agents
    tests/tools/venv.sh .venv-a2a-agents --group a2a-agents
    FIBACTION_AGENTS=required try tests/transports/mcp/test_official_clients.py \
        tests/transports/a2a/test_agents_of_others.py
    ;;
frontends)
    FIBACTION_NODE=required tests/javascript/install.sh build/frontends tests/javascript/frontends
    FIBACTION_FRONTENDS=required try tests/javascript/test_frontends.py
    ;;
*) exit 2 ;;
esac
